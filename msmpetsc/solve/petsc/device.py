"""Device of a run, chosen by PETSc's matrix type, and PETSc objects in its memory.

``Memory`` gives access to a PETSc vector as an array without a copy, and makes vectors and dense
matrices over existing arrays. ``memory_of`` returns the memory of an array: CPU or GPU.

CuPy and numba's CUDA target are imported only if a GPU is requested, because CPU runs need neither.
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
# PETSc's option, and the C variable that holds its value
GPU_AWARE_MPI = "use_gpu_aware_mpi"


def choose(comm: MPI.Comm, device: str | None) -> None:
    """Set the matrix type of runs from ``--device`` (collective).

    Raises InputError if ``-mat_type`` contradicts the device, or if the device is not available.
    """
    mat_type = PETSc.Options().getAll().get(OPTION)
    if device and mat_type is not None and (mat_type in ON_GPU) != (device == "cuda"):
        raise InputError(f"--device {device} and -{OPTION} {mat_type} contradict each other")
    if device == "cuda" and mat_type is None:
        PETSc.Options().setValue(OPTION, AIJCUSPARSE)
    sender(comm)


def sender(comm: MPI.Comm) -> Callable[[Array], Array]:
    """Return a function that copies arrays to the device of the run (collective).

    Raises InputError on all ranks if the device is a GPU, but a rank lacks a GPU or PETSc lacks
    CUDA.
    """
    if PETSc.Options().getAll().get(OPTION) not in ON_GPU:
        return lambda array: array
    # Reading the option marks it as used; Verlet has no matrix that would read it.
    wanted = PETSc.Options().getString(OPTION)
    with together(comm):
        lacking = what_is_missing()
        if lacking:
            raise InputError(f"--device cuda (-{OPTION} {wanted}): {lacking}")
    import cupy

    # If there are several GPUs, PETSc takes the same GPU.
    cupy.cuda.Device(PETSc.COMM_WORLD.rank % cupy.cuda.runtime.getDeviceCount()).use()
    if GPU_AWARE_MPI not in PETSc.Options().getAll():
        # Otherwise PETSc stops at an MPI without GPU support. The variable is set
        # directly, because PETSc has already read its options.
        ctypes.c_bool.in_dll(petsc_library(), GPU_AWARE_MPI).value = False
    send: Callable[[Array], Array] = cupy.asarray
    return send


def what_is_missing() -> str | None:
    """Return the reason why this process cannot compute on a GPU, as text; None if it can.

    The test asks the CUDA runtime, because PETSc crashes at exit if there is no GPU.
    """
    try:
        import cupy
        from numba import cuda  # noqa: F401
    except ImportError as error:
        return f"{error.name or 'CuPy'} cannot be imported; pip install 'msmpetsc[cuda]' brings it"
    try:
        count = cupy.cuda.runtime.getDeviceCount()
    # A missing or old driver raises errors of CuPy, the CUDA runtime or the loader.
    except Exception as error:
        return f"no GPU is seen: {str(error).splitlines()[0]}"
    if not count:
        return "no GPU is seen"
    if PETSc.Sys.hasExternalPackage("cuda"):
        return None
    return "this PETSc was built without CUDA; scripts/build_petsc_cuda builds a PETSc with CUDA"


class Memory:
    """Access to PETSc's vectors and matrices in CPU memory, and PETSc's names of their types."""

    vec_type, mat_type = PETSc.Vec.Type.STANDARD, PETSc.Mat.Type.AIJ

    def read(self, vector: PETSc.Vec) -> Floats:
        """Return this rank's numbers of a vector for reading."""
        return np.asarray(vector.array_r)

    def write(self, vector: PETSc.Vec) -> Floats:
        """Return this rank's numbers of a vector, for immediate reading and writing."""
        return np.asarray(vector.array)

    def over(self, array: Floats, comm: PETSc.Comm) -> PETSc.Vec:
        """Return a vector that shares the memory of the ranks' arrays (n,)."""
        return PETSc.Vec().createWithArray(array, (len(array), None), comm=comm)

    def dense(self, rows: tuple[int, int], columns: int, comm: PETSc.Comm) -> PETSc.Mat:
        """Return a dense matrix.

        rows    : number of this rank's rows, and of all rows
        columns : number of columns
        """
        return _ready(PETSc.Mat().createDense((rows, (None, columns)), comm=comm))

    def values(self, dense: PETSc.Mat) -> Floats:
        """Return this rank's part of a dense matrix by columns, for immediate use."""
        return np.asarray(dense.getDenseArray().T.reshape(-1))


class CudaMemory(Memory):
    """Access to PETSc's vectors and matrices in GPU memory.

    A pointer is restored at once, as petsc4py does for DLPack, so that PETSc takes the GPU's copy
    as valid. Later writes are safe, because PETSc and CuPy both use the default stream.
    """

    vec_type, mat_type = PETSc.Vec.Type.CUDA, PETSc.Mat.Type.AIJCUSPARSE

    def read(self, vector: PETSc.Vec) -> Floats:
        return self._view(vector, "r")

    def write(self, vector: PETSc.Vec) -> Floats:
        return self._view(vector, "rw")

    def over(self, array: Floats, comm: PETSc.Comm) -> PETSc.Vec:
        return PETSc.Vec().createCUDAWithArrays(
            cudahandle=array.data.ptr,  # type: ignore[attr-defined]
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
    """Return GPU memory owned by PETSc as an array (size,), valid while PETSc keeps the memory."""
    import cupy

    numbers: Floats = cupy.empty(0)
    if size:
        memory = cupy.cuda.UnownedMemory(pointer, 8 * size, None, cupy.cuda.Device().id)
        numbers = cupy.ndarray((size,), np.float64, cupy.cuda.MemoryPointer(memory, 0))
    return numbers


def _ready(dense: PETSc.Mat) -> PETSc.Mat:
    """Return a dense matrix after its set-up and assembly (collective)."""
    dense.setUp()
    dense.assemble()
    return dense


HOST, CUDA = Memory(), CudaMemory()


def memory_of(array: Floats) -> Memory:
    """Return the memory, CPU or GPU, that holds an array."""
    return HOST if on_host(array) else CUDA
