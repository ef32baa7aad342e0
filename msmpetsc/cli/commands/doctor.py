"""``msmpetsc doctor``: check the installation and print a remedy for each missing package.

Each probe runs in its own process, because an incompatible library may end the process.
"""

import argparse
import platform
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import msmpetsc
from msmpetsc.app.ranks import environment, last_error
from msmpetsc.errors import EXTRAS

OK, MISSING, BROKEN = "ok", "missing", "BROKEN"
# time limit of a probe [s]; far above the time to load a library
PATIENCE = 60
# program of each probe; it prints its finding, or nothing
PROBES = {
    "PETSc": """
import numpy
from petsc4py import PETSc
has = getattr(PETSc.Sys, "hasExternalPackage", lambda package: False)
if numpy.dtype(PETSc.ScalarType).name == "float64":
    version = ".".join(map(str, PETSc.Sys.getVersion()))
    packages = [package for package in ("MUMPS", "hypre", "CUDA") if has(package)]
    print(f"{version}, {8 * numpy.dtype(PETSc.IntType).itemsize}-bit integers", *packages, sep=", ")
""",
    "MPI": """
from mpi4py import MPI
if MPI.COMM_WORLD.size == 2 and MPI.COMM_WORLD.rank == 0:  # two ranks' lines may come as one
    library = MPI.Get_library_version().splitlines()[0].strip(chr(0))
    print(library.partition(",")[0] + ", mpiexec starts ranks that meet")
""",
    "GPU": """
import cupy
for number in range(cupy.cuda.runtime.getDeviceCount()):
    print(cupy.cuda.runtime.getDeviceProperties(number)["name"].decode())
""",
    "HDF5": "import h5py; print(h5py.version.hdf5_version)",
    "kernels": """
from msmpetsc.backend.kernel_cache import writable
if writable():
    print(f"kept in {writable()}")
""",
}
# state and message of a probe that prints nothing
NOTHING = {
    "PETSc": (BROKEN, "a PETSc of real double numbers is needed (--with-scalar-type=real)"),
    "MPI": (BROKEN, "mpiexec -n 2 starts two runs of one rank: mpi4py was built for another MPI"),
    "GPU": (MISSING, "no CUDA device on this machine"),
    "kernels": (
        MISSING,
        "no folder can store them, so that each process compiles them for a minute: set "
        "NUMBA_CACHE_DIR to a writable folder",
    ),
}
# command that installs a package, if ``pip install NAME`` does not
BRINGS = {
    "petsc4py": "apt install python3-petsc4py, or with PETSC_DIR set: pip install 'msmpetsc[run]'",
    "mpi4py": "apt install python3-mpi4py openmpi-bin, or pip install 'msmpetsc[run]'",
    "cupy": "pip install 'msmpetsc[cuda]'",
}
# extras for few machines, not reported if they are missing
NO_INSTALL = {"cuda"}
# requirements of every run
NEEDED = {"PETSc", "MPI", "HDF5", "extra run"}

# name of a probe or extra, its state, and a message
Finding = tuple[str, str, str]


def run(_: argparse.Namespace) -> int:
    """Print the findings; return 1 if a requirement of runs is missing or broken."""
    lacking = False
    for name, state, message in findings():
        print(f"{state:8} {name:16} {message}", flush=True)
        lacking |= state != OK and name in NEEDED
    return int(lacking)


def findings() -> Iterator[Finding]:
    """Yield the findings of all probes, of msmpetsc itself, and of the packages of each extra."""
    for name, code in PROBES.items():
        # without mpi4py, mpiexec would print a message of its own
        has_ranks = name == "MPI" and find_spec("mpi4py")
        state, message = probed(code, *(("mpiexec", "-n", "2") if has_ranks else ()))
        if not message:
            state, message = NOTHING[name]
        yield name, state, message.replace("\n", ", ")
    folder = Path(msmpetsc.__file__).parent
    yield "msmpetsc", OK, f"{msmpetsc.__version__} in {folder}, Python {platform.python_version()}"
    yield from packages()


def probed(code: str, *launcher: str) -> tuple[str, str]:
    """Run a probe in its own Python process; return its state, and its output or failure.

    launcher : words before the Python command, for example "mpiexec", "-n", "2"
    """
    command = [*launcher, sys.executable, "-c", code]
    try:
        done = subprocess.run(
            command,
            env=environment(),
            timeout=PATIENCE,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
        )
    except FileNotFoundError:
        remedy = "apt install openmpi-bin, or load the module of the cluster's MPI"
        return BROKEN, f"there is no {command[0]}: {remedy}"
    except subprocess.TimeoutExpired:
        return BROKEN, f"does not answer within {PATIENCE} s: {' '.join(launcher)}"
    if done.returncode == 0:
        return OK, done.stdout.strip()
    if missing := re.search(r"^ModuleNotFoundError: No module named '(\w+)'$", done.stderr, re.M):
        name = missing[1]
        return MISSING, f"{name}: {BRINGS.get(name, f'pip install {name}')}"
    return BROKEN, last_error(done.stderr)[:160] or f"ends with status {done.returncode}"


def packages() -> Iterator[Finding]:
    """Yield for each extra whether its packages are installed."""
    for extra, names in EXTRAS.items():
        missing = [name for name in names if not find_spec(name)]
        if not missing:
            yield f"extra {extra}", OK, ", ".join(names)
        elif extra not in NO_INSTALL:
            remedy = f"{', '.join(missing)}: pip install 'msmpetsc[{extra}]'"
            yield f"extra {extra}", MISSING, remedy
