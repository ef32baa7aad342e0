"""PETSc's vectors and matrices over the memory that a run's arrays are in: the CPU's, or that of a CUDA GPU.

Both forms do the same: hand out the numbers of a vector as an array, without a copy, and make
vectors and dense blocks over arrays of ours. Which one it is, ``memory_of`` an array tells.
"""

import numpy as np
from petsc4py import PETSc

from msmpetsc.backend import cuda
from msmpetsc.backend.arrays import Floats, on_host
from msmpetsc.solve.petsc.library import dense_pointer


class Memory:
    """PETSc's vectors and matrices in the memory of the CPU.

    types : PETSc's names of vectors and matrices there
    """

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
        return cuda.view(dense_pointer(dense), dense.getLocalSize()[0] * dense.getSize()[1])

    def _view(self, vector: PETSc.Vec, mode: str) -> Floats:
        pointer = vector.getCUDAHandle(mode)
        vector.restoreCUDAHandle(pointer, mode)
        return cuda.view(pointer, vector.getLocalSize())


def _ready(dense: PETSc.Mat) -> PETSc.Mat:
    dense.setUp()
    dense.assemble()
    return dense


HOST, CUDA = Memory(), CudaMemory()


def memory_of(array: Floats) -> Memory:
    return HOST if on_host(array) else CUDA
