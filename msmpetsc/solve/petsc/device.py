"""The device of a run, by the type of PETSc's matrix, and PETSc's objects in its memory.

Both forms of ``Memory`` do the same: hand out the numbers of a vector as an array, without a copy, and make
vectors and dense blocks over arrays of ours. Which one it is, ``memory_of`` an array tells.

CuPy and numba's CUDA target are imported by those alone who ask for a GPU: a CPU's run needs neither.
"""

import ctypes
from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Array, Floats, on_host
from msmpetsc.comm import together
from msmpetsc.errors import InputError
from msmpetsc.solve.petsc.library import dense_pointer, petsc_library

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
    import cupy

    cupy.cuda.Device(
        PETSc.COMM_WORLD.rank % cupy.cuda.runtime.getDeviceCount()
    ).use()  # of several the one PETSc takes
    if AWARE not in PETSc.Options().getAll():
        # Not all MPI know GPUs, and without one PETSc stops at the first device use. It has read its options by now.
        ctypes.c_bool.in_dll(petsc_library(), AWARE).value = False
    send: Callable[[Array], Array] = cupy.asarray
    return send


def what_is_missing() -> str | None:
    """Why this process cannot compute on a GPU, in words; None if it can."""
    if not PETSc.Sys.hasExternalPackage("cuda"):
        return "this PETSc was built without CUDA; scripts/build_petsc_cuda makes one that was not"
    return missing_cuda()


def missing_cuda() -> str | None:
    """Why Python has no GPU, in words; None if it has. The runtime is asked, for PETSc would crash at exit."""
    try:
        import cupy
        from numba import cuda  # noqa: F401
    except ImportError as error:
        return f"{error.name or 'CuPy'} cannot be imported; pip install 'msmpetsc[cuda]' brings it"
    try:
        return None if cupy.cuda.runtime.getDeviceCount() else "no GPU is seen"
    except (
        Exception
    ) as error:  # of CuPy, of the runtime or of what loads it: no driver, one too old, no library
        return f"no GPU is seen: {str(error).splitlines()[0]}"


class Memory:
    """PETSc's vectors and matrices in the memory of the CPU; ``vec_type`` and ``mat_type`` are PETSc's names there."""

    vec_type, mat_type = PETSc.Vec.Type.STANDARD, PETSc.Mat.Type.AIJ

    def read(self, vector: PETSc.Vec) -> Floats:
        """Return this rank's numbers, not to be written to."""
        return np.asarray(vector.array_r)

    def write(self, vector: PETSc.Vec) -> Floats:
        """Return this rank's numbers, to be written to at once; reading them as well is allowed."""
        return np.asarray(vector.array)

    def over(self, array: Floats, comm: PETSc.Comm) -> PETSc.Vec:
        """Return a vector of all ranks' arrays (n,), which it keeps its numbers in."""
        return PETSc.Vec().createWithArray(array, (len(array), None), comm=comm)

    def dense(self, rows: tuple[int, int], columns: int, comm: PETSc.Comm) -> PETSc.Mat:
        """Return a dense matrix; rows: of this rank, of all."""
        return _ready(PETSc.Mat().createDense((rows, (None, columns)), comm=comm))

    def values(self, dense: PETSc.Mat) -> Floats:
        """Return this rank's part of a dense matrix, column after column, to be read or written at once."""
        return np.asarray(dense.getDenseArray().T.reshape(-1))


class CudaMemory(Memory):
    """PETSc's vectors and matrices in the memory of a GPU.

    Pointers are given back at once, as petsc4py does for DLPack: PETSc then knows that the GPU has the last word, and
    what is written later is in the same stream as all of PETSc's work, the default one.
    """

    vec_type, mat_type = PETSc.Vec.Type.CUDA, PETSc.Mat.Type.AIJCUSPARSE

    def read(self, vector: PETSc.Vec) -> Floats:
        return self._view(vector, "r")

    def write(self, vector: PETSc.Vec) -> Floats:
        return self._view(vector, "rw")

    def over(self, array: Floats, comm: PETSc.Comm) -> PETSc.Vec:
        return PETSc.Vec().createCUDAWithArrays(
            cudahandle=array.data.ptr,  # type: ignore[attr-defined]  # CuPy's
            size=(len(array), None),
            comm=comm,
        )

    def dense(self, rows: tuple[int, int], columns: int, comm: PETSc.Comm) -> PETSc.Mat:
        return _ready(PETSc.Mat().createDenseCUDA((rows, (None, columns)), comm=comm))

    def values(self, dense: PETSc.Mat) -> Floats:
        return view(dense_pointer(dense), dense.getLocalSize()[0] * dense.getSize()[1])

    def _view(self, vector: PETSc.Vec, mode: str) -> Floats:
        pointer = vector.getCUDAHandle(mode)
        vector.restoreCUDAHandle(pointer, mode)
        return view(pointer, vector.getLocalSize())


def view(pointer: int, size: int) -> Floats:
    """Return memory of a GPU that is someone else's, (size,) numbers, as an array; valid as long as that memory."""
    import cupy

    numbers: Floats = cupy.empty(0)
    if size:
        memory = cupy.cuda.UnownedMemory(pointer, 8 * size, None, cupy.cuda.Device().id)
        numbers = cupy.ndarray((size,), np.float64, cupy.cuda.MemoryPointer(memory, 0))
    return numbers


def _ready(dense: PETSc.Mat) -> PETSc.Mat:
    dense.setUp()
    dense.assemble()
    return dense


HOST, CUDA = Memory(), CudaMemory()


def memory_of(array: Floats) -> Memory:
    return HOST if on_host(array) else CUDA
