"""Select the clone's own Python and package for a script; the script must import this first."""

import os
import sys
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# scripts/setup creates it
PYTHON = ROOT / ".venv" / "bin" / "python"
# packages without which a Python cannot run msmpetsc
NEEDED = ("numpy", "numba", "petsc4py", "mpi4py")


def _use_own_python() -> None:
    """Restart the script with the clone's Python if the present Python lacks a package."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing and (not PYTHON.exists() or Path(sys.prefix) == PYTHON.parents[1]):
        sys.exit(f"{sys.argv[0]}: {', '.join(missing)} not installed: run scripts/setup first")
    if missing:
        os.execv(PYTHON, [str(PYTHON), *sys.argv])


_use_own_python()
# here and in child processes, the clone's package precedes an installed package
sys.path.insert(0, str(ROOT))
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
