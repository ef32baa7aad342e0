"""Whether a run is on a GPU: the type of PETSc's matrix decides, and all else follows from where the arrays are."""

import ctypes
from collections.abc import Callable

from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend import cuda
from msmpetsc.backend.arrays import Array
from msmpetsc.comm import together
from msmpetsc.errors import InputError
from msmpetsc.solve.petsc.library import petsc_library

OPTION = "mat_type"
AIJCUSPARSE = "aijcusparse"
ON_GPU = {AIJCUSPARSE, "seqaijcusparse", "mpiaijcusparse"}
AWARE = "use_gpu_aware_mpi"  # PETSc's option, and the variable that it is read into


def choose(comm: MPI.Comm, device: str | None) -> None:
    """Make ``--device`` the matrix type that runs have (collective).

    Raises InputError where both are given and differ, and at once what ``sender`` would raise later.
    """
    mat_type = PETSc.Options().getAll().get(OPTION)
    if device and mat_type is not None and (mat_type in ON_GPU) != (device == "cuda"):
        raise InputError(f"--device {device} and -{OPTION} {mat_type} contradict each other")
    if device == "cuda" and mat_type is None:
        PETSc.Options().setValue(OPTION, AIJCUSPARSE)
    sender(comm)


def sender(comm: MPI.Comm) -> Callable[[Array], Array]:
    """Function that takes arrays to where runs compute (collective).

    Raises InputError on all ranks where that is a GPU and one of them has none, or PETSc has no CUDA.
    """
    if PETSc.Options().getAll().get(OPTION) not in ON_GPU:
        return lambda array: array
    wanted = PETSc.Options().getString(OPTION)  # and is marked as used: verlet has no matrix
    with together(comm):
        lacking = what_is_missing()
        if lacking:
            raise InputError(f"--device cuda (-{OPTION} {wanted}): {lacking}")
    cuda.use_device(PETSc.COMM_WORLD.rank)
    if AWARE not in PETSc.Options().getAll():
        # Not all MPI know GPUs, and without one PETSc stops at the first device use. It has read its options by now.
        ctypes.c_bool.in_dll(petsc_library(), AWARE).value = False
    return cuda.send


def what_is_missing() -> str | None:
    """Why this process cannot compute on a GPU, in words; None if it can."""
    if not PETSc.Sys.hasExternalPackage("cuda"):
        return "this PETSc was built without CUDA; scripts/build_petsc_cuda makes one that was not"
    return cuda.missing()
