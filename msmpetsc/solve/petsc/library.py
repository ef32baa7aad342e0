"""PETSc's C functions that petsc4py lacks, and its errors as the one line of an InputError."""

import ctypes
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache

import numpy as np
from petsc4py import PETSc

from msmpetsc.backend.arrays import Array, Floats, Indices
from msmpetsc.errors import InputError, did_you_mean

Integer = ctypes.c_int64 if PETSc.IntType().itemsize == 8 else ctypes.c_int32
INSERT = int(PETSc.InsertMode.INSERT_VALUES)


@cache
def petsc_library() -> ctypes.CDLL:
    """Return PETSc's library, opened once; what it prints may come by Python, whose lock is kept therefore."""
    return ctypes.PyDLL(PETSc.__file__)  # petsc4py's extension has those of libpetsc, too


def total_iterations(ksp: PETSc.KSP) -> int:
    """Iterations of all solves of a KSP, whoever called it (KSPGetTotalIterations)."""
    count = Integer()
    petsc_library().KSPGetTotalIterations(ctypes.c_void_p(ksp.handle), ctypes.byref(count))
    return count.value


def dense_pointer(matrix: PETSc.Mat) -> int:
    """Address of a rank's part of a dense matrix, maybe on a GPU (MatDenseGetArrayAndMemType)."""
    library, handle, array, kind = (
        petsc_library(),
        ctypes.c_void_p(matrix.handle),
        ctypes.c_void_p(),
        ctypes.c_int(),
    )
    library.MatDenseGetArrayAndMemType(handle, ctypes.byref(array), ctypes.byref(kind))
    pointer = array.value or 0
    library.MatDenseRestoreArrayAndMemType(handle, ctypes.byref(array))
    return pointer


def preallocate_coo(matrix: PETSc.Mat, rows: Indices, columns: Indices) -> None:
    """Say which entries ``set_values_coo`` will set, by global indices (n,); negative ones are left
    out, those named twice are added (MatSetPreallocationCOO) (collective)."""
    index = [np.ascontiguousarray(i, PETSc.IntType) for i in (rows, columns)]
    count = ctypes.c_int64(len(rows))  # PetscCount
    _check(
        petsc_library().MatSetPreallocationCOO(
            ctypes.c_void_p(matrix.handle), count, *map(_address, index)
        )
    )


def set_values_coo(matrix: PETSc.Mat, values: Floats) -> None:
    """Set those entries to values (n,), on a GPU if the matrix is there (MatSetValuesCOO)."""
    _check(
        petsc_library().MatSetValuesCOO(
            ctypes.c_void_p(matrix.handle), _address(values), ctypes.c_int(INSERT)
        )
    )


@contextmanager
def replaced_option(name: str, value: str) -> Iterator[None]:
    """Replace the value of an option while the block is run."""
    database, before = PETSc.Options(), PETSc.Options().getAll()
    database.setValue(name, value)
    try:
        yield
    finally:
        if name in before:
            database.setValue(name, before[name])
        else:
            database.delValue(name)


def set_chebyshev(ksp: PETSc.KSP, least: float, greatest: float) -> None:
    """Give Chebyshev's method, if it is, what it damps between (KSPChebyshevSetEigenvalues)."""
    bounds = ctypes.c_double(greatest), ctypes.c_double(least)
    _check(petsc_library().KSPChebyshevSetEigenvalues(ctypes.c_void_p(ksp.handle), *bounds))


def _address(array: Array) -> ctypes.c_void_p:
    on_gpu = getattr(array, "__cuda_array_interface__", None)
    return ctypes.c_void_p(on_gpu["data"][0] if on_gpu else array.ctypes.data)


def _check(error: int) -> None:
    if error:
        raise PETSc.Error(error)


@contextmanager
def petsc_errors(what: str, abandon: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Make PETSc's errors in the block, or in the function decorated, an InputError ``what``: its last words.

    ImportError is that of an object of type python whose context is not there.

    abandon : called after such an error
    """
    try:
        yield
    except (PETSc.Error, ImportError) as error:
        # No other name for it: a frame that holds an exception is held by it, and PETSc's objects with both, for ever.
        # Of newer petsc4py, what Python code within PETSc raised is the cause of its own error.
        cause = error.__cause__
        if cause is not None and not isinstance(cause, (PETSc.Error, ImportError)):
            raise cause  # noqa: B904 (the error itself, not another)
        abandon()
        raise InputError(f"{what}: {last_words(cause or error)}") from None


def last_words(error: BaseException) -> str:
    """Message of a PETSc error, without its calls; for an unknown type with the nearest."""
    lines = str(error).splitlines()
    said = [
        line.partition("] ")[2] for line in lines if line.startswith("[") and "() at " not in line
    ]
    words = said[-1] if said else lines[0]
    wanted = re.search(r"requested (KSP|PC|SNES) type (\w+)", words)
    if wanted is None:
        return words
    types = vars(getattr(PETSc, wanted[1]).Type).values()
    return words + did_you_mean(wanted[2], [name for name in types if isinstance(name, str)])
