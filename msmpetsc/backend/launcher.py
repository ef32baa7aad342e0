"""Threads on a CUDA GPU: bodies compiled by numba, launched by the driver. Imported by those alone who have a GPU.

A step of some thousand nodes is many launches of little work. numba's own launch takes 90 us for ten arrays, the one
here a tenth of that: the words of an array's description are put together once, and the driver is called directly.
"""

import ctypes
import re
import struct
from collections.abc import Callable
from functools import cache, lru_cache
from importlib.metadata import version
from itertools import chain
from typing import Any

import cupy
import numba
import numpy as np
from numba import cuda as untyped

from msmpetsc.backend import kernel_cache
from msmpetsc.backend.arrays import Array
from msmpetsc.errors import MsmpetscError

cuda: Any = untyped
THREADS = 128  # of a block: registers, not their number, bound the kernels that look at all neighbours of a node
KEPT = 4096  # descriptions of arrays
SCALARS = {
    bool: "?7x",
    int: "q",
    float: "d",
}  # as the driver takes them (struct): each in eight bytes of its own
TYPES = {"?7x": numba.types.boolean, "q": numba.types.int64, "d": numba.types.float64}

Words = tuple[float, ...]  # of an argument, as the kernel takes them
Kind = Any  # of an argument: a scalar's format, an array's description, or a NamedTuple's class and its fields' kinds


@cache
def launcher(body: Callable[..., None]) -> Callable[..., None]:
    """Return what backend.kernel calls: one thread for each index below a count, in CuPy's current stream."""
    known: dict[tuple[Kind, ...], Launch] = {}

    def launch(count: int, *arguments: Any) -> None:
        if count:
            kinds, words = zip(*map(as_argument, arguments), strict=True)
            if kinds not in known:
                known[kinds] = Launch(body, kinds)
            known[kinds](count, chain.from_iterable(words))

    return launch


def as_argument(value: Array | float | tuple[Any, ...]) -> tuple[Kind, Words]:
    """Return an argument's kind, which its type and its words' format follow from, and the words."""
    if isinstance(value, tuple):
        kinds, words = zip(*map(as_argument, value), strict=True)
        return (type(value), *kinds), tuple(chain.from_iterable(words))
    if isinstance(value, cupy.ndarray):
        return described(value.data.ptr, value.shape, value.strides, value.dtype.str)
    number = value.item() if isinstance(value, np.generic) else value
    return SCALARS[type(number)], (number,)  # type: ignore[return-value]  # no array


@lru_cache(maxsize=KEPT)
def described(
    pointer: int, shape: tuple[int, ...], strides: tuple[int, ...], dtype: str
) -> tuple[str, Words]:
    """Return the kind of an array, "f8 2 C", and the words that numba's kernels take for it.

    These are no owner, no parent, its size, and where it lies.
    """
    size = np.dtype(dtype).itemsize
    by_row = tuple(np.cumprod((size, *shape[:0:-1]))[::-1])
    by_column = tuple(np.cumprod((size, *shape[:-1])))
    layout = "C" if strides == by_row or 0 in shape else "F" if strides == by_column else "A"
    return f"{dtype} {len(shape)} {layout}", (
        0,
        0,
        int(np.prod(shape)),
        size,
        pointer,
        *shape,
        *strides,
    )


def type_of(kind: Kind) -> object:
    """Return numba's type of a kind of argument."""
    if isinstance(kind, tuple):
        fields = [type_of(one) for one in kind[1:]]
        return numba.types.BaseTuple.from_types(fields, kind[0])  # type: ignore[no-untyped-call]
    if kind in TYPES:
        return TYPES[kind]
    dtype, dimensions, layout = kind.split()
    return numba.types.Array(numba.from_dtype(np.dtype(dtype)), int(dimensions), layout)


def format_of(kind: Kind) -> str:
    """Return how the words of an argument are packed (struct)."""
    if isinstance(kind, tuple):
        return "".join(map(format_of, kind[1:]))
    return kind if kind in TYPES else f"{5 + 2 * int(kind.split()[1])}q"


class Launch:
    """A body compiled for arguments of some types, and the memory that its words are handed over in."""

    def __init__(self, body: Callable[..., None], kinds: tuple[Kind, ...]):
        self.module = cupy.cuda.function.Module()
        ptx = compiled(body, kinds)
        self.module.load(ptx.encode())
        entry = re.search(r"\.entry\s+(\w+)", ptx)
        assert entry, "a kernel has an entry"
        self.function = self.module.get_function(entry[1])
        words = struct.Struct("q" + "".join(map(format_of, kinds)))
        self.pack, self.memory = words.pack_into, ctypes.create_string_buffer(words.size)
        first, number = ctypes.addressof(self.memory), len(self.memory) // 8
        self.pointers = (ctypes.c_void_p * number)(*range(first, first + 8 * number, 8))

    def __call__(self, count: int, words: chain[float]) -> None:
        self.pack(self.memory, 0, count, *words)  # the driver copies them before it returns
        stream = cupy.cuda.get_current_stream().ptr
        blocks = -(-count // THREADS)
        status = driver()(
            self.function.ptr, blocks, 1, 1, THREADS, 1, 1, 0, stream, self.pointers, None
        )
        if status:
            raise MsmpetscError(f"the GPU refused a kernel: CUDA error {status}")


def compiled(body: Callable[..., None], kinds: tuple[Kind, ...]) -> str:
    """Return the PTX of a body for these arguments and this GPU, kept as other kernels are."""
    capability = cupy.cuda.Device().compute_capability
    name = kernel_cache.key(body, map(type_of, kinds), ("PTX", capability, version("numba-cuda")))
    if kept := kernel_cache.load(name):
        return kept.decode()
    ptx = ptx_of(body, kinds, (int(capability[:-1]), int(capability[-1])))
    kernel_cache.save(name, ptx.encode())
    return ptx


def ptx_of(body: Callable[..., None], kinds: tuple[Kind, ...], capability: tuple[int, int]) -> str:
    """Return the PTX of a body for arguments of these kinds."""
    arguments = numba.types.Tuple([type_of(kind) for kind in kinds])  # type: ignore[no-untyped-call]
    signature = numba.types.void(numba.types.int64, arguments)
    ptx, _ = cuda.compile_ptx(kernel_of(body), signature, cc=capability)
    return str(ptx)


def kernel_of(body: Callable[..., None]) -> Callable[..., None]:
    """Return the kernel of a body: it takes a count and the tuple of the further arguments."""
    inlined = cuda.jit(device=True)(body)

    def threads(count: int, arguments: tuple[Any, ...]) -> None:
        inlined(cuda.grid(1), count, cuda.gridsize(1), *arguments)

    return threads


@cache
def driver() -> Callable[..., int]:
    """Return cuLaunchKernel of CUDA's driver."""
    launch = ctypes.CDLL("libcuda.so.1").cuLaunchKernel
    launch.argtypes = [ctypes.c_void_p, *[ctypes.c_uint] * 7, *[ctypes.c_void_p] * 3]
    return launch
