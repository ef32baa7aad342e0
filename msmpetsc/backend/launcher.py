"""Threads on a CUDA GPU, by numba: imported by those alone who have one."""

import os
from collections.abc import Callable, Hashable
from functools import cache, lru_cache

import cupy
import numba
import numpy as np
from numba import cuda

# A small body needs few threads, and so do the nodes in contact. numba reads its environment again now and then.
os.environ.setdefault("NUMBA_CUDA_LOW_OCCUPANCY_WARNINGS", "0")
numba.config.reload_config()

THREADS = 128  # of a block: registers, not their number, bound the kernels that look at all neighbours of a node
KEPT = 4096  # arrays that numba has seen


@cache
def launcher(body: Callable[..., None]) -> Callable[..., None]:
    """Return what backend.kernel calls: one thread for each index below a count, in CuPy's current stream."""
    kernel, known = kernel_of(body), {}

    def launch(count, *arguments):
        if not count:
            return
        kinds, arguments = zip(*map(as_argument, arguments), strict=True)
        if kinds not in known:  # left to itself numba looks for the types at each launch, which takes longer than that
            known[kinds] = kernel.specialize(count, arguments)
        known[kinds][-(-count // THREADS), THREADS, _stream()](count, arguments)

    return launch


def kernel_of(body: Callable[..., None]) -> Callable[..., None]:
    """Return the CUDA kernel of a body: it takes a count and the tuple of the body's further arguments."""
    compiled = cuda.jit(device=True)(body)

    @cuda.jit
    def threads(count, arguments):
        compiled(cuda.grid(1), count, cuda.gridsize(1), *arguments)

    return threads


def as_argument(value: np.ndarray | float) -> tuple[object, object]:
    """Return what says for which type a kernel is compiled, and the value: an array as numba wants it, or as it is."""
    if isinstance(value, cupy.ndarray):
        return _seen_by_numba(value.data.ptr, value.shape, value.strides, value.dtype.str)
    return type(value), value


@lru_cache(maxsize=KEPT)
def _seen_by_numba(
    pointer: int, shape: tuple[int, ...], strides: tuple[int, ...], kind: str
) -> tuple[Hashable, object]:
    """Return numba's view of an array, which owns nothing; made once, for that takes longer than a launch."""
    interface = {"data": (pointer, False), "shape": shape, "strides": strides, "typestr": kind, "version": 3}
    array = cuda.from_cuda_array_interface(interface, sync=False)
    return (kind, len(shape), array.is_c_contiguous(), array.is_f_contiguous()), array


def _stream() -> int:
    pointer = cupy.cuda.get_current_stream().ptr
    return cuda.external_stream(pointer) if pointer else 0
