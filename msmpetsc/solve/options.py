"""PETSc options that nobody used: an error that names the nearest valid one.

PETSc keeps no list of the options it knows, but it prints those an object looks for when asked for
help. That is captured, and only when there is a wrong name to correct.
"""

import ctypes
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.solve.library import Integer, petsc_library

READ_AT_THE_END = re.compile(r"^(citations|get_total_flops|mpidump|options_left|options_view)$")
READ_WHILE_SOLVING = re.compile(r"_view|_dump|_converged_reason|_monitor|_test_jacobian|_rate")
ASKED = "asked_"  # PETSc prints a help text once a prefix, and the bare one's may have had its turn
TYPES = {
    "snes": (PETSc.SNES, ["newtonls", "newtontr", "anderson", "ngmres", "qn"]),
    "ksp": (PETSc.KSP, ["cg", "pipecg", "minres", "gmres", "preonly"]),
    "pc": (PETSc.PC, ["jacobi", "icc", "cholesky", "bjacobi", "gamg", "hypre", "sor"]),
}


def refuse_unused(comm: MPI.Comm, ours: set[str], at_end: bool = False, awaited: tuple[str, ...] = ()) -> None:
    """Raise InputError for options of the user that no object has looked at (collective).

    ours    : names of the preset's own options, which another type may well leave unused
    at_end  : before the end, options that are read while solving still have their time
    awaited : prefixes of solvers that are only made while solving
    """
    if "snes_mf" in PETSc.Options().getAll():  # it would crash
        raise InputError("-snes_mf: Hessians are applied spring by spring already, without differences")
    unused = [
        name
        for name in _left()
        if name not in ours
        and not READ_AT_THE_END.search(name)
        and (at_end or not READ_WHILE_SOLVING.search(name))
        and not name.startswith(awaited)
    ]
    message = None
    if comm.rank == 0 and unused:
        known = _known_names() - set(unused)
        message = "\n".join(f"-{name}: no part of this run uses this PETSc option{did_you_mean(name, known)}" for name in unused)
    message = comm.bcast(message)
    if message:
        raise InputError(message)


def _left() -> list[str]:
    """Names of the options that have not been looked at (PetscOptionsLeftGet, which petsc4py lacks)."""
    library = petsc_library()
    strings = ctypes.POINTER(ctypes.c_char_p)
    count, names, values = Integer(), strings(), strings()
    library.PetscOptionsLeftGet(None, ctypes.byref(count), ctypes.byref(names), ctypes.byref(values))
    left = [names[i].decode() for i in range(count.value)]
    library.PetscOptionsLeftRestore(None, ctypes.byref(count), ctypes.byref(names), ctypes.byref(values))
    return left


def _known_names() -> set[str]:
    """Names that the help of the usual solvers prints."""
    database = PETSc.Options()
    with _captured_stdout() as text:
        database.setValue("help", None)
        for kind, types in TYPES.values():
            for name in types:
                solver = kind().create(PETSc.COMM_SELF)
                solver.setOptionsPrefix(f"{ASKED}{name}_")
                with suppress(PETSc.Error):  # a PETSc without hypre
                    solver.setType(name)
                    solver.setFromOptions()
                solver.destroy()
        matrix = PETSc.Mat().create(PETSc.COMM_SELF)
        matrix.setOptionsPrefix(f"{ASKED}mat_")
        matrix.setFromOptions()
        matrix.destroy()
        database.delValue("help")
    printed = re.findall(r"(?<=\s-)[a-z]\w+(?=[ :])", text[0])
    return {re.sub(f"^{ASKED}[a-z]+_", "", name) for name in printed}


@contextmanager
def _captured_stdout() -> Iterator[list[str]]:
    """What the C library prints in the block; the text is there after it."""
    text = [""]
    sys.stdout.flush()
    ctypes.CDLL(None).fflush(None)
    kept = os.dup(1)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 1)
        try:
            yield text
        finally:
            ctypes.CDLL(None).fflush(None)
            os.dup2(kept, 1)
            os.close(kept)
            file.seek(0)
            text[0] = file.read().decode(errors="replace")
