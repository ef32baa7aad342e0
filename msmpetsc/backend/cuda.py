"""A CUDA GPU: what is missing for one, and arrays in its memory.

CuPy and numba's CUDA target are imported by those alone who ask for a GPU: a CPU's run needs neither.
"""

import numpy as np

from msmpetsc.backend.arrays import Array, Floats


def missing() -> str | None:
    """Return why there is no GPU, in words, None if there is one.

    The runtime is asked, for PETSc would crash at exit.
    """
    try:
        import cupy
        from numba import cuda  # noqa: F401
    except ImportError as error:
        return f"{error.name or 'CuPy'} cannot be imported; pip install 'msmpetsc[cuda]' brings it"
    try:
        return None if cupy.cuda.runtime.getDeviceCount() else "no GPU is seen"
    except Exception as error:  # of CuPy, of the runtime or of what loads it: no driver, one too old, no library
        return f"no GPU is seen: {str(error).splitlines()[0]}"


def use_device(rank: int) -> None:
    """Use, of several GPUs, the one that PETSc takes too: r modulo their number for rank r."""
    import cupy

    cupy.cuda.Device(rank % cupy.cuda.runtime.getDeviceCount()).use()


def send(array: Array) -> Array:
    """Return a copy of an array in the memory of the GPU."""
    import cupy

    copy: Array = cupy.asarray(array)
    return copy


def view(pointer: int, size: int) -> Floats:
    """Return memory of someone else, (size,) numbers, as an array; valid as long as that memory."""
    import cupy

    numbers: Floats = cupy.empty(0)
    if size:
        memory = cupy.cuda.UnownedMemory(pointer, 8 * size, None, cupy.cuda.Device().id)
        numbers = cupy.ndarray((size,), np.float64, cupy.cuda.MemoryPointer(memory, 0))
    return numbers


def name() -> str:
    """Return the name of the GPU in use."""
    import cupy

    return str(cupy.cuda.runtime.getDeviceProperties(cupy.cuda.Device().id)["name"].decode())
