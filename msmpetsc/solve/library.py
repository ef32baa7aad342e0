"""PETSc's C functions that petsc4py lacks."""

import ctypes

from petsc4py import PETSc

Integer = ctypes.c_int64 if PETSc.IntType().itemsize == 8 else ctypes.c_int32


def petsc_library() -> ctypes.CDLL:
    return ctypes.CDLL(PETSc.__file__)  # petsc4py's extension; its symbols include those of libpetsc


def total_iterations(ksp: PETSc.KSP) -> int:
    """Iterations of all solves of a KSP, whoever called it (KSPGetTotalIterations)."""
    count = Integer()
    petsc_library().KSPGetTotalIterations(ctypes.c_void_p(ksp.handle), ctypes.byref(count))
    return count.value
