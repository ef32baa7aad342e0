"""``msmpetsc doctor``: what is installed, what is missing and the command that brings it, and what is broken.

What could end the process, libraries that do not fit together above all, is loaded in one of its own.
"""

import argparse
import platform
import re
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path

import msmpetsc
from msmpetsc.app.ranks import environment, last_error
from msmpetsc.errors import EXTRAS

OK, MISSING, BROKEN = "ok", "missing", "BROKEN"
PATIENCE = 60  # [s] that a library may take to load
PROBES = {  # programs that say what they find, or nothing
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
NOTHING = {  # what it means if they say nothing
    "PETSc": (BROKEN, "a PETSc of real double numbers is needed (--with-scalar-type=real)"),
    "MPI": (BROKEN, "mpiexec -n 2 starts two runs of one rank: mpi4py was built for another MPI"),
    "GPU": (MISSING, "no CUDA device on this machine"),
    "kernels": (
        MISSING,
        "no folder can keep them: each process compiles them, a minute; NUMBA_CACHE_DIR names one",
    ),
}
BRINGS = {  # of packages whose names alone do not say how to get them
    "petsc4py": "apt install python3-petsc4py, or with PETSC_DIR set: pip install 'msmpetsc[run]'",
    "mpi4py": "apt install python3-mpi4py openmpi-bin, or pip install 'msmpetsc[run]'",
    "cupy": "pip install 'msmpetsc[cuda]'",
}
NO_INSTALL = {"cuda", "peers"}  # extras for few machines: what lacks them lacks nothing
NEEDED = {"PETSc", "MPI", "HDF5", "extra run"}  # by every run

Finding = tuple[str, str, str]  # what, its state, and in words


def run(_: argparse.Namespace) -> int:
    """Print the findings; return 1 where a run lacks something that it needs."""
    lacking = False
    for what, state, words in findings():
        print(f"{state:8} {what:16} {words}", flush=True)
        lacking |= state != OK and what in NEEDED
    return int(lacking)


def findings() -> Iterator[Finding]:
    """Yield the findings of all probes, then those of the packages of each extra."""
    for name, code in PROBES.items():
        has_ranks = name == "MPI" and find_spec("mpi4py")  # or mpiexec would say something else
        state, words = probed(code, *(("mpiexec", "-n", "2") if has_ranks else ()))
        if not words:
            state, words = NOTHING[name]
        yield name, state, words.replace("\n", ", ")
    folder = Path(msmpetsc.__file__).parent
    yield "msmpetsc", OK, f"{msmpetsc.__version__} in {folder}, Python {platform.python_version()}"
    yield from packages()


def probed(code: str, *launcher: str) -> tuple[str, str]:
    """Return the state of a probe run in its own Python, with its output or the reason of its failure."""
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
    if gone := re.search(r"^ModuleNotFoundError: No module named '(\w+)'$", done.stderr, re.M):
        return MISSING, f"{gone[1]}: {BRINGS.get(gone[1], f'pip install {gone[1]}')}"
    return BROKEN, last_error(done.stderr)[:160] or f"ends with status {done.returncode}"


def packages() -> Iterator[Finding]:
    """Yield whether the packages of each extra are installed and can be imported."""
    all_names = sorted({name for names in EXTRAS.values() for name in names})
    with ThreadPoolExecutor() as pool:
        states = pool.map(probed, (f"import {name}" for name in all_names))
    found = dict(zip(all_names, states, strict=True))
    for extra, names in EXTRAS.items():
        gone = [name for name in names if found[name][0] == MISSING]
        if broken := [f"{name}: {found[name][1]}" for name in names if found[name][0] == BROKEN]:
            yield f"extra {extra}", BROKEN, "; ".join(broken)
        elif gone and not (extra in NO_INSTALL and len(gone) == len(names)):
            yield f"extra {extra}", MISSING, f"{', '.join(gone)}: pip install 'msmpetsc[{extra}]'"
        elif not gone:
            yield f"extra {extra}", OK, ", ".join(names)
