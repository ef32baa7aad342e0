"""PETSc's C functions that petsc4py lacks."""

import ctypes
import os

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
    """Address of this rank's numbers of a dense matrix, on the GPU if it has them there
    (MatDenseGetArrayAndMemType)."""
    library, handle, array, kind = petsc_library(), ctypes.c_void_p(matrix.handle), ctypes.c_void_p(), ctypes.c_int()
    library.MatDenseGetArrayAndMemType(handle, ctypes.byref(array), ctypes.byref(kind))
    pointer = array.value or 0
    library.MatDenseRestoreArrayAndMemType(handle, ctypes.byref(array))
    return pointer


def library_file() -> str:
    """Path of PETSc's C library, as the loader has it (dladdr)."""
    info, address = _DlInfo(), ctypes.cast(petsc_library().PetscInitialize, ctypes.c_void_p)
    is_known = ctypes.CDLL(None).dladdr(address, ctypes.byref(info))
    return os.fsdecode(info.file) if is_known and info.file else PETSc.__file__


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


class _DlInfo(ctypes.Structure):
    _fields_ = [
        ("file", ctypes.c_char_p), ("base", ctypes.c_void_p), ("symbol", ctypes.c_char_p), ("address", ctypes.c_void_p)
    ]  # fmt: skip
