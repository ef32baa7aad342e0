"""The versions of the libraries that a run rests on."""

import platform
import re
from collections.abc import Iterator

PYTHON = f"Python {platform.python_version()}"


def library_versions() -> Iterator[str]:
    """Yield name and version of PETSc, MPI and Python; what cannot be loaded says so."""
    for name, version in {"PETSc": petsc_version, "MPI": mpi_version}.items():
        try:
            yield version()
        except Exception:  # a library that is missing, or built for another: each in its own way
            yield f"no {name}"
    yield PYTHON


def petsc_version() -> str:
    """Return "PETSc 3.22.4"."""
    from petsc4py import PETSc

    return f"PETSc {'.'.join(map(str, PETSc.Sys.getVersion()))}"


def mpi_version() -> str:
    """Return "Open MPI v5.0.7", or as much of what the library says of itself."""
    from mpi4py import MPI

    return re.split(r"[,\n\0]", MPI.Get_library_version())[0].strip()
