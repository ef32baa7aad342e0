"""``msmpetsc doctor``: what is installed, what is missing and the command that brings it, and what is broken.

What could end the process, libraries that do not fit together above all, is loaded in one of its own.
"""

import argparse
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import msmpetsc
from msmpetsc.cli.ranks import world
from msmpetsc.errors import EXTRAS, extra_of, one_line

OK, MISSING, BROKEN = "ok", "missing", "BROKEN"
PATIENCE = 60  # [s] that a library may take to load
PETSC = """
import json, numpy
from petsc4py import PETSc
has = lambda package: bool(PETSc.Sys.hasExternalPackage(package)) if hasattr(PETSc.Sys, "hasExternalPackage") else None
print(json.dumps({
    "version": ".".join(map(str, PETSc.Sys.getVersion())), "bits": 8 * numpy.dtype(PETSc.IntType).itemsize,
    "scalar": numpy.dtype(PETSc.ScalarType).name, **{name: has(name) for name in ("MUMPS", "hypre", "CUDA")}}))
"""
RANKS = """
from mpi4py import MPI
if MPI.COMM_WORLD.rank == 0:  # two ranks' lines may come as one
    print(MPI.COMM_WORLD.size, MPI.Get_library_version().splitlines()[0].strip(chr(0)))
"""
DEVICE = """
import cupy
for number in range(cupy.cuda.runtime.getDeviceCount()):
    print(cupy.cuda.runtime.getDeviceProperties(number)["name"].decode())
"""
HDF5 = "import h5py; print(h5py.version.hdf5_version)"
CACHE = """
import os
from msmpetsc.backend.kernel import cache_is_empty
print("empty" if cache_is_empty() else "filled", os.environ["NUMBA_CACHE_DIR"])
"""
MESHES = """
from msmpetsc.geometry.registry import MODELS, find
print(", ".join(name for name in MODELS if find(name)))
"""
IMPORTS = """
import importlib, json
reasons = {{}}
for name in {names}:
    try:
        importlib.import_module(name)
    except Exception as error:
        reasons[name] = (str(error).strip().splitlines() or [type(error).__name__])[0][:120]
print(json.dumps(reasons))
"""
USES = {  # of packages that PETSc may be configured with
    "MUMPS": ("the presets fast-msm", "configure PETSc with --download-mumps"),
    "hypre": ("-pc_type hypre alone, which no preset has", "configure PETSc with --download-hypre"),
    "CUDA": ("--device cuda alone", "scripts/build_petsc_cuda builds one"),
}
BRINGS = {  # where an extra alone does not
    "petsc4py": "apt install python3-petsc4py, or with PETSC_DIR set: pip install 'msmpetsc[run]'",
    "mpi4py": "apt install python3-mpi4py openmpi-bin, or pip install 'msmpetsc[run]'",
    "h5py": "pip install h5py",
}
NO_INSTALL = {"cuda", "peers"}  # extras for few machines: what lacks them lacks nothing
NEEDED = {"PETSc", "MPI", "HDF5", "packages", "extra run"}  # by every run

Finding = tuple[str, str, str]  # what, its state, and in words


class Unsound(Exception):
    """Raised of a thing that is missing or broken: its state, and what brings or ails it."""


def run(_: argparse.Namespace) -> int:
    """Print a line for each thing; return 1 where a run lacks something that it needs."""
    if world().rank != 0:
        return 0
    lacking = False
    for name, examine in EXAMINATIONS.items():
        for what, state, words in examined(name, examine):
            print(f"{state:8} {what:16} {words}", flush=True)
            lacking |= state != OK and what in NEEDED
    return int(lacking)


def examined(name: str, examine: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """Yield the findings of an examination, whatever happens in it."""
    try:
        yield from examine()
    except Unsound as error:
        state, words = error.args
        yield name, state, words
    except Exception as error:  # whatever is broken in an installation: it must be named, not end this
        yield name, BROKEN, one_line(error)


def installed(package: str) -> bool:
    """Return whether Python finds a package, without importing it."""
    try:
        return find_spec(package) is not None
    except (ImportError, ValueError):
        return False


def said(code: str, *launcher: str) -> str:
    """Return what a Python of its own prints. Raises Unsound."""
    command = [*launcher, sys.executable, "-c", code]
    alone = {name: value for name, value in os.environ.items() if not name.startswith(("OMPI_COMM", "PMIX_", "PMI_"))}
    try:
        done = subprocess.run(
            command, env=alone, timeout=PATIENCE, stdin=subprocess.DEVNULL, capture_output=True, text=True
        )
    except FileNotFoundError:
        remedy = "apt install openmpi-bin, or load the module of the cluster's MPI"
        raise Unsound(BROKEN, f"there is no {command[0]}: {remedy}") from None
    except subprocess.TimeoutExpired:
        raise Unsound(BROKEN, f"does not answer within {PATIENCE} s: {' '.join(launcher)}") from None
    if done.returncode == 0:
        return done.stdout.strip()
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    last = [f"ends with status {done.returncode}", *lines][-1][:160]
    gone = re.fullmatch(r"ModuleNotFoundError: No module named '(\w+)[\w.]*'", last)
    if gone and not installed(gone[1]):
        remedy = BRINGS.get(gone[1], f"pip install 'msmpetsc[{extra_of(gone[1])}]'")
        raise Unsound(MISSING, f"{gone[1]}: {remedy}")
    raise Unsound(BROKEN, last)


def petsc() -> Iterator[Finding]:
    """PETSc, its integers and its numbers, and the packages that it was configured with."""
    facts = json.loads(said(PETSC).splitlines()[-1])
    words = f"{facts['version']}, {facts['bits']}-bit integers, {facts['scalar']}"
    if facts["scalar"] != "float64":
        raise Unsound(BROKEN, f"{words}: a PETSc of real double numbers is needed (--with-scalar-type=real)")
    yield "PETSc", OK, words
    for name, (use, remedy) in USES.items():
        if facts[name]:
            yield f"PETSc with {name}", OK, f"for {use}"
        else:
            yield f"PETSc with {name}", MISSING, f"for {use}: {remedy}"


def ranks() -> Iterator[Finding]:
    """MPI: whether two ranks meet."""
    oversubscribed = ("--oversubscribe",) if "Open MPI" in said(RANKS) else ()
    size, _, library = said(RANKS, "mpiexec", *oversubscribed, "-n", "2").splitlines()[-1].partition(" ")
    if size != "2":
        raise Unsound(BROKEN, "mpiexec -n 2 starts two runs of one rank: mpi4py was built for another MPI")
    yield "MPI", OK, f"{library.partition(',')[0]}, mpiexec starts ranks that meet"


def device() -> Iterator[Finding]:
    """A CUDA GPU."""
    if not installed("cupy"):
        raise Unsound(MISSING, "for --device cuda alone: pip install 'msmpetsc[cuda]'")
    names = said(DEVICE).splitlines()
    if not names:
        raise Unsound(MISSING, "no CUDA device on this machine")
    yield "GPU", OK, ", ".join(names)


def results() -> Iterator[Finding]:
    """HDF5, as h5py has it."""
    yield "HDF5", OK, said(HDF5)


def kernels() -> Iterator[Finding]:
    """The cache of compiled kernels."""
    state, folder = said(CACHE).split(" ", 1)
    nearest = next(path for path in (Path(folder), *Path(folder).parents) if path.exists())
    if not os.access(nearest, os.W_OK):
        remedy = "export NUMBA_CACHE_DIR=FOLDER"
        raise Unsound(MISSING, f"{nearest} cannot be written, each run compiles anew: {remedy}")
    words = {"filled": "compiled", "empty": "not yet compiled: the first run takes a minute more"}
    yield "kernels", OK, words[state]


def packages() -> Iterator[Finding]:
    """The packages of each extra: missing, or there but broken, so that they cannot be imported."""
    place = Path(msmpetsc.__file__).parent
    yield "msmpetsc", OK, f"{msmpetsc.__version__} in {place}, Python {platform.python_version()}"
    found = sorted({name for names in EXTRAS.values() for name in names if installed(name)})
    reasons = json.loads(said(IMPORTS.format(names=found)).splitlines()[-1])
    for extra, names in EXTRAS.items():
        gone = [name for name in names if name not in found]
        if broken := [f"{name}: {reasons[name]}" for name in names if name in reasons]:
            yield f"extra {extra}", BROKEN, "; ".join(broken)
        elif gone and not (extra in NO_INSTALL and len(gone) == len(names)):
            yield f"extra {extra}", MISSING, f"{', '.join(gone)}: pip install 'msmpetsc[{extra}]'"
        elif not gone:
            yield f"extra {extra}", OK, ", ".join(names)


def meshes() -> Iterator[Finding]:
    """Models of the registry that lie on this machine."""
    names = said(MESHES)
    if not names:
        raise Unsound(MISSING, "no named model, for the shipped scenes only: msmpetsc fetch --list")
    yield "meshes", OK, names


EXAMINATIONS: dict[str, Callable[[], Iterator[Finding]]] = {
    "PETSc": petsc,
    "MPI": ranks,
    "GPU": device,
    "HDF5": results,
    "kernels": kernels,
    "packages": packages,
    "meshes": meshes,
}
