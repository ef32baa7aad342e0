"""PETSc's C functions that petsc4py lacks."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import numpy as np
from petsc4py import PETSc

Integer = ctypes.c_int64 if PETSc.IntType().itemsize == 8 else ctypes.c_int32
INSERT = int(PETSc.InsertMode.INSERT_VALUES)


@cache
def petsc_library() -> ctypes.CDLL:
    """Return PETSc's library, opened once."""
    return ctypes.CDLL(PETSc.__file__)  # petsc4py's extension; its symbols include those of libpetsc


def total_iterations(ksp: PETSc.KSP) -> int:
    """Iterations of all solves of a KSP, whoever called it (KSPGetTotalIterations)."""
    count = Integer()
    petsc_library().KSPGetTotalIterations(ctypes.c_void_p(ksp.handle), ctypes.byref(count))
    return count.value


def dense_pointer(matrix: PETSc.Mat) -> int:
    """Address of this rank's numbers of a dense matrix, on the GPU if it has them there
    (MatDenseGetArrayAndMemType)."""
    library, handle, array, kind = petsc_library(), ctypes.c_void_p(matrix.handle), ctypes.c_void_p(), ctypes.c_int()
    library.MatDenseGetArrayAndMemType(handle, ctypes.byref(array), ctypes.byref(kind))
    pointer = array.value or 0
    library.MatDenseRestoreArrayAndMemType(handle, ctypes.byref(array))
    return pointer


def open_viewer(option: str) -> None:
    """Open and close the viewer that an option of the user's names (PetscOptionsGetViewer) (collective).

    Raises PETSc.Error where there is no such viewer, or its file cannot be written.
    """
    library, viewer, kind, is_set = petsc_library(), ctypes.c_void_p(), ctypes.c_int(), ctypes.c_int()
    world = ctypes.c_void_p.in_dll(library, "PETSC_COMM_WORLD")
    wanted = (world, None, None, f"-{option}".encode(), *map(ctypes.byref, (viewer, kind, is_set)))
    newer = hasattr(library, "PetscOptionsCreateViewer")  # its name from PETSc 3.22 on
    create = library.PetscOptionsCreateViewer if newer else library.PetscOptionsGetViewer
    error = create(*wanted) or library.PetscViewerDestroy(ctypes.byref(viewer))
    if error:
        raise PETSc.Error(error)


def preallocate_coo(matrix: PETSc.Mat, rows: np.ndarray, columns: np.ndarray) -> None:
    """Say which entries ``set_values_coo`` will set, by their global indices (n,); negative ones are left out, those
    named twice are added (MatSetPreallocationCOO) (collective)."""
    index = [np.ascontiguousarray(i, PETSc.IntType) for i in (rows, columns)]
    count = ctypes.c_int64(len(rows))  # PetscCount
    _check(petsc_library().MatSetPreallocationCOO(ctypes.c_void_p(matrix.handle), count, *map(_address, index)))


def set_values_coo(matrix: PETSc.Mat, values: np.ndarray) -> None:
    """Set those entries; values (n,) on the CPU or, of a matrix that is there, on a GPU (MatSetValuesCOO)
    (collective)."""
    _check(petsc_library().MatSetValuesCOO(ctypes.c_void_p(matrix.handle), _address(values), ctypes.c_int(INSERT)))


@contextmanager
def replaced_option(name: str, value: str) -> Iterator[None]:
    """Have another value of an option that is set, or none, while the block is run."""
    database, before = PETSc.Options(), PETSc.Options().getAll()
    database.setValue(name, value)
    yield
    if name in before:
        database.setValue(name, before[name])
    else:
        database.delValue(name)


def set_chebyshev(ksp: PETSc.KSP, least: float, greatest: float) -> None:
    """Give Chebyshev's method the eigenvalues that it damps between; no matter for other methods
    (KSPChebyshevSetEigenvalues)."""
    bounds = ctypes.c_double(greatest), ctypes.c_double(least)
    _check(petsc_library().KSPChebyshevSetEigenvalues(ctypes.c_void_p(ksp.handle), *bounds))


@cache
def square_restricts_transposed() -> bool:
    """Whether MatRestrict applies a square matrix transposed, as that of PETSc 3.22 does, or as it is, as in 3.18."""
    matrix = PETSc.Mat().createAIJ((2, 2), comm=PETSc.COMM_SELF)
    matrix.setUp()
    matrix[0, 1] = 1.0
    matrix.assemble()
    x, y = matrix.createVecs()
    x[0] = 1.0
    x.assemble()
    _check(petsc_library().MatRestrict(*(ctypes.c_void_p(each.handle) for each in (matrix, x, y))))
    is_transposed = bool(y[1])
    for owned in (matrix, x, y):
        owned.destroy()
    return is_transposed


def _address(array: np.ndarray) -> ctypes.c_void_p:
    on_gpu = getattr(array, "__cuda_array_interface__", None)
    return ctypes.c_void_p(on_gpu["data"][0] if on_gpu else array.ctypes.data)


def _check(error: int) -> None:
    if error:
        raise PETSc.Error(error)
