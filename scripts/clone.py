"""Runs a script of this folder by the clone's own Python and package, whatever Python started it: import this first."""

import os
import sys
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PYTHON = ROOT / ".venv" / "bin" / "python"  # scripts/setup makes it
NEEDED = ("numpy", "numba", "petsc4py", "mpi4py")  # what marks a Python that can run msmpetsc


def _use_own_python() -> None:
    """Start the script again by the clone's Python, if this one lacks what msmpetsc needs."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing and (not PYTHON.exists() or Path(sys.prefix) == PYTHON.parents[1]):
        sys.exit(f"{sys.argv[0]}: {', '.join(missing)} not installed: run scripts/setup first")
    if missing:
        os.execv(PYTHON, [str(PYTHON), *sys.argv])


_use_own_python()
sys.path.insert(
    0, str(ROOT)
)  # the clone's package goes before an installed one, here and in child processes
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
