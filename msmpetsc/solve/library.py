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


def dense_pointer(matrix: PETSc.Mat) -> int:
    """Where this rank's numbers of a dense matrix are, on the GPU if it has them there (MatDenseGetArrayAndMemType)."""
    library, handle, array, kind = petsc_library(), ctypes.c_void_p(matrix.handle), ctypes.c_void_p(), ctypes.c_int()
    library.MatDenseGetArrayAndMemType(handle, ctypes.byref(array), ctypes.byref(kind))
    found = array.value or 0
    library.MatDenseRestoreArrayAndMemType(handle, ctypes.byref(array))
    return found
