"""Kernel launches on a CUDA GPU: numba compiles the body, the CUDA driver launches it.

The module imports CuPy. A time step of a small lattice launches many short kernels, so the overhead
of a launch counts. It is lower here than in numba, because array descriptors are cached and the
driver is called directly.
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
# threads of a block [-]; more would exceed the registers of kernels that visit all
# neighbours of a node
THREADS = 128
# struct format of a scalar [-]; the driver takes each in eight bytes
SCALARS = {bool: "?7x", int: "q", float: "d"}
TYPES = {"?7x": numba.types.boolean, "q": numba.types.int64, "d": numba.types.float64}

# machine words that pass an argument to a kernel
Words = tuple[float, ...]
# kind of an argument: a scalar's format, an array's type as in "f8 2 C", or the class
# of a NamedTuple and the kinds of its fields
Kind = Any


@cache
def launcher(body: Callable[..., None]) -> Callable[..., None]:
    """Return the GPU kernel of a body. It launches a thread per index in CuPy's current stream."""
    known: dict[tuple[Kind, ...], Launch] = {}

    def launch(count: int, *arguments: Any) -> None:
        if count:
            kinds, words = zip(*map(as_argument, arguments), strict=True)
            if kinds not in known:
                known[kinds] = Launch(body, kinds)
            known[kinds](count, chain.from_iterable(words))

    return launch


def as_argument(value: Array | float | tuple[Any, ...]) -> tuple[Kind, Words]:
    """Return the kind of an argument, and the machine words that pass it to a kernel."""
    if isinstance(value, tuple):
        kinds, words = zip(*map(as_argument, value), strict=True)
        return (type(value), *kinds), tuple(chain.from_iterable(words))
    if isinstance(value, cupy.ndarray):
        return described(value.data.ptr, value.shape, value.strides, value.dtype.str)
    number = value.item() if isinstance(value, np.generic) else value
    return SCALARS[type(number)], (number,)  # type: ignore[return-value]  # no array


# the size bounds the memory
@lru_cache(maxsize=4096)
def described(
    pointer: int, shape: tuple[int, ...], strides: tuple[int, ...], dtype: str
) -> tuple[str, Words]:
    """Return the kind of an array, as in "f8 2 C", and the words that numba's kernels take for it.

    The words are numba's array structure: owner and parent (both null), number of items, item size,
    pointer, shape and strides.
    """
    size = np.dtype(dtype).itemsize
    by_row = tuple(np.cumprod((size, *shape[:0:-1]))[::-1])
    layout = "C" if strides == by_row or 0 in shape else "A"
    words = 0, 0, int(np.prod(shape)), size, pointer, *shape, *strides
    return f"{dtype} {len(shape)} {layout}", words


def type_of(kind: Kind) -> object:
    """Return numba's type of an argument of this kind."""
    if isinstance(kind, tuple):
        fields = [type_of(field) for field in kind[1:]]
        return numba.types.BaseTuple.from_types(fields, kind[0])  # type: ignore[no-untyped-call]
    if kind in TYPES:
        return TYPES[kind]
    dtype, dimensions, layout = kind.split()
    return numba.types.Array(numba.from_dtype(np.dtype(dtype)), int(dimensions), layout)


def format_of(kind: Kind) -> str:
    """Return the struct format of the words of an argument."""
    if isinstance(kind, tuple):
        return "".join(map(format_of, kind[1:]))
    return kind if kind in TYPES else f"{5 + 2 * int(kind.split()[1])}q"


class Launch:
    """A body compiled for arguments of given kinds, with the buffer for their words."""

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
        # The driver copies the words before it returns, so the buffer can be reused.
        self.pack(self.memory, 0, count, *words)
        stream = cupy.cuda.get_current_stream().ptr
        blocks = -(-count // THREADS)
        status = driver()(
            self.function.ptr, blocks, 1, 1, THREADS, 1, 1, 0, stream, self.pointers, None
        )
        if status:
            raise MsmpetscError(f"the GPU refused a kernel: CUDA error {status}")


def compiled(body: Callable[..., None], kinds: tuple[Kind, ...]) -> str:
    """Return the PTX of a body for arguments of these kinds and the current GPU, from the cache."""
    capability = cupy.cuda.Device().compute_capability
    name = kernel_cache.key(body, map(type_of, kinds), ("PTX", capability, version("numba-cuda")))
    if kept := kernel_cache.load(name):
        return kept.decode()
    ptx = ptx_of(body, kinds, (int(capability[:-1]), int(capability[-1])))
    kernel_cache.save(name, ptx.encode())
    return ptx


def ptx_of(body: Callable[..., None], kinds: tuple[Kind, ...], capability: tuple[int, int]) -> str:
    """Compile a body to PTX for arguments of these kinds and a compute capability."""
    arguments = numba.types.Tuple([type_of(kind) for kind in kinds])  # type: ignore[no-untyped-call]
    signature = numba.types.void(numba.types.int64, arguments)
    ptx, _ = cuda.compile_ptx(kernel_of(body), signature, cc=capability)
    return str(ptx)


def kernel_of(body: Callable[..., None]) -> Callable[..., None]:
    """Return the CUDA kernel of a body, which takes a count and a tuple of arguments."""
    inlined = cuda.jit(device=True)(body)

    def threads(count: int, arguments: tuple[Any, ...]) -> None:
        inlined(cuda.grid(1), count, cuda.gridsize(1), *arguments)

    return threads


@cache
def driver() -> Callable[..., int]:
    """Return cuLaunchKernel of the CUDA driver."""
    launch = ctypes.CDLL("libcuda.so.1").cuLaunchKernel
    launch.argtypes = [ctypes.c_void_p, *[ctypes.c_uint] * 7, *[ctypes.c_void_p] * 3]
    return launch
