"""PETSc's C functions that petsc4py lacks, and PETSc errors as InputError with a single line."""

import ctypes
import gc
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_array

from msmpetsc.backend.arrays import Array, Floats, Indices
from msmpetsc.comm import reduced
from msmpetsc.errors import InputError, did_you_mean

# largest integer of PETSc; its configuration decides between 32 and 64 bits
LARGEST = int(np.iinfo(PETSc.IntType).max)
ADVICE = "a PETSc configured with --with-64-bit-indices can"
Integer = ctypes.c_int64 if PETSc.IntType().itemsize == 8 else ctypes.c_int32
INSERT = int(PETSc.InsertMode.INSERT_VALUES)


@cache
def petsc_library() -> ctypes.CDLL:
    """Return PETSc's C library.

    Calls keep Python's lock (PyDLL), because PETSc may call Python.
    """
    # petsc4py's extension module also exports the symbols of libpetsc.
    return ctypes.PyDLL(PETSc.__file__)


def refuse_unknowns(nodes: int) -> None:
    """Raise InputError if PETSc cannot number the three coordinates of so many nodes."""
    if 3 * nodes > LARGEST:
        most = f"the {LARGEST} unknowns that PETSc can number here"
        raise InputError(
            f"cages: the three coordinates of {nodes} nodes are more than {most}; {ADVICE}"
        )


def refuse_nonzeros(comm: MPI.Comm, own: int) -> None:
    """Raise InputError if a rank has more nonzeros than PETSc can count (collective).

    own : number of nonzeros of this rank
    """
    most = reduced(comm, own, MPI.MAX)
    if most > LARGEST:
        raise InputError(
            f"cages: {most} nonzeros of the system matrix on one rank are more than the {LARGEST} "
            f"that PETSc can count here; more ranks have fewer each, or {ADVICE}"
        )


def total_iterations(ksp: PETSc.KSP) -> int:
    """Return the number of iterations of all solves of a KSP (KSPGetTotalIterations)."""
    count = Integer()
    petsc_library().KSPGetTotalIterations(ctypes.c_void_p(ksp.handle), ctypes.byref(count))
    return count.value


def dense_pointer(matrix: PETSc.Mat) -> int:
    """Return the address, on CPU or GPU, of a local dense matrix (MatDenseGetArrayAndMemType)."""
    library = petsc_library()
    handle, array, kind = ctypes.c_void_p(matrix.handle), ctypes.c_void_p(), ctypes.c_int()
    library.MatDenseGetArrayAndMemType(handle, ctypes.byref(array), ctypes.byref(kind))
    pointer = array.value or 0
    library.MatDenseRestoreArrayAndMemType(handle, ctypes.byref(array))
    return pointer


def preallocate_coo(matrix: PETSc.Mat, rows: Indices, columns: Indices) -> None:
    """Set the entries, by global indices (n,), that ``set_values_coo`` will fill (collective).

    Entries with a negative index are left out, and repeated entries are summed
    (MatSetPreallocationCOO).
    """
    index = [np.ascontiguousarray(i, PETSc.IntType) for i in (rows, columns)]
    # a PetscCount
    count = ctypes.c_int64(len(rows))
    _check(
        petsc_library().MatSetPreallocationCOO(
            ctypes.c_void_p(matrix.handle), count, *map(_address, index)
        )
    )


def set_values_coo(matrix: PETSc.Mat, values: Floats) -> None:
    """Set the preallocated entries to values (n,), on the matrix's device (MatSetValuesCOO)."""
    _check(
        petsc_library().MatSetValuesCOO(
            ctypes.c_void_p(matrix.handle), _address(values), ctypes.c_int(INSERT)
        )
    )


def petsc_csr(rows: csr_array) -> tuple[Indices, Indices, Floats]:
    """Return compressed rows with PETSc's type of indices: begin, columns and values."""
    begin, columns = (part.astype(PETSc.IntType) for part in (rows.indptr, rows.indices))
    return begin, columns, rows.data


def set_up_aij(
    matrix: PETSc.Mat, sizes: object, mat_type: str, rows: csr_array, side: int = 1
) -> None:
    """Give a new matrix its sizes, type, block size ``side`` and this rank's rows (collective)."""
    matrix.setSizes(sizes)
    matrix.setBlockSize(side)
    matrix.setType(mat_type)
    matrix.setPreallocationCSR(petsc_csr(rows))


@contextmanager
def replaced_option(name: str, value: str) -> Iterator[None]:
    """Replace the value of an option during the block."""
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
    """Set the eigenvalue bounds if the KSP is Chebyshev's method (KSPChebyshevSetEigenvalues)."""
    bounds = ctypes.c_double(greatest), ctypes.c_double(least)
    _check(petsc_library().KSPChebyshevSetEigenvalues(ctypes.c_void_p(ksp.handle), *bounds))


def _address(array: Array) -> ctypes.c_void_p:
    """Return the address of an array on the CPU or the GPU."""
    on_gpu = getattr(array, "__cuda_array_interface__", None)
    return ctypes.c_void_p(on_gpu["data"][0] if on_gpu else array.ctypes.data)


def _check(error: int) -> None:
    """Raise PETSc.Error for a non-zero error code."""
    if error:
        raise PETSc.Error(error)


class Owner(Protocol):
    """An object that destroys PETSc objects.

    owned : destroys them when closed
    """

    owned: ExitStack


def keep_for_ever(owner: Owner) -> None:
    """Keep an owner's PETSc objects for ever: destroying them after an error may crash."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(owner))
    owner.owned = ExitStack()


@contextmanager
def petsc_errors(heading: str, owner: Owner | None = None) -> Iterator[None]:
    """Turn PETSc errors of the block, or of the decorated function, into an InputError.

    PETSc raises ImportError if an object of type python has no context. Python's garbage collector
    is off in the block.

    heading : beginning of the message, which ends with PETSc's own message
    owner   : owner of the PETSc objects in use, which are kept for ever after an error
    """
    collects = gc.isenabled()
    # Since Python 3.12 garbage may be collected in petsc4py's error handler. This
    # discards the exception that passes through PETSc, and petsc4py crashes without it.
    gc.disable()
    try:
        yield
    except (PETSc.Error, ImportError) as error:
        # In newer petsc4py, an exception of Python code within PETSc is the cause of
        # the error. Its traceback holds this frame, so a second name for the exception
        # here would keep PETSc's objects alive.
        cause = error.__cause__
        if cause is not None and not isinstance(cause, (PETSc.Error, ImportError)):
            raise cause  # noqa: B904
        if owner:
            keep_for_ever(owner)
        raise InputError(f"{heading}: {last_words(cause or error)}") from None
    finally:
        if collects:
            gc.enable()


def last_words(error: BaseException) -> str:
    """Return the message of a PETSc error without its call stack.

    If the message names an unknown type, add the nearest known type.
    """
    lines = str(error).splitlines()
    messages = [
        line.partition("] ")[2] for line in lines if line.startswith("[") and "() at " not in line
    ]
    message = messages[-1] if messages else lines[0]
    unknown = re.search(r"requested (KSP|PC|SNES) type (\w+)", message)
    if unknown is None:
        return message
    types = vars(getattr(PETSc, unknown[1]).Type).values()
    return message + did_you_mean(unknown[2], [name for name in types if isinstance(name, str)])
