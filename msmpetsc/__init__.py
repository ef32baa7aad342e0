"""Elastic bodies from closed surface meshes: mass-spring lattices stepped with PETSc."""

import hashlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msmpetsc.output.reader import Result

__version__ = "0.1.0"


def _kernel_folder() -> Path:
    """A folder for the compiled kernels of just these sources.

    numba looks for changes in a kernel's own file alone, not in those of the kernels it calls: after an update it
    would go on with parts of the old version.
    """
    package = Path(__file__).parent
    sources = [path.read_bytes() for path in sorted(package.rglob("*.py"))]
    kernels = b"".join(source for source in sources if b"njit" in source or b"@kernel" in source)
    return package / "__pycache__" / f"kernels-{hashlib.sha256(kernels).hexdigest()[:16]}"


os.environ.setdefault("NUMBA_CACHE_DIR", str(_kernel_folder()))  # before numba is imported


def open(path: str | Path) -> "Result":
    """Open a result file to read its frames, lattice, surface, embedding and scene; needs h5py and numpy alone.

        with msmpetsc.open("out/bunny_fall.h5") as run:
            last = run.frames.position[-1]

    Raises InputError, one line, if the file is no result, or damaged.
    """
    from msmpetsc.output.reader import Result  # late: the package itself stays quick to import

    return Result(path)


def run(scene: str | Path | None = None, output: str | Path | None = None, **options: Any) -> Path:
    """Simulate a scene as ``msmpetsc run`` does, on all ranks, and return the path of the result (cli.main.simulate).

        path = msmpetsc.run("scenes/bunny_fall.toml", "out/b.h5", frames=10, petsc_options={"ksp_rtol": 1e-5})

    Raises InputError, one line, for what cannot be used, and StepFailed for a step that did not converge.
    """
    from msmpetsc.cli.main import simulate

    return simulate(scene, output, **options)
