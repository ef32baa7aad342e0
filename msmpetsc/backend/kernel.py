"""Kernels for CPU and GPU: a compiled loop over indices on a CPU, a thread per index on a GPU."""

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import numba

from msmpetsc.backend.arrays import on_host
from msmpetsc.backend.kernel_cache import KernelCache

Function = TypeVar("Function", bound=Callable[..., Any])


def njit(**options: Any) -> Callable[[Function], Function]:
    """Compile a function as ``numba.njit(**options)`` does, with this package's cache on disk."""

    def compiled(function: Function) -> Function:
        dispatcher: Any = numba.njit(**options)(function)
        dispatcher._cache = KernelCache(function)
        return dispatcher  # type: ignore[no-any-return]

    return compiled


def kernel(body: Callable[..., None]) -> Callable[..., None]:
    """Return a kernel that runs a body for all indices: ``kernel(body)(count, *arguments)``.

    ``body(first, count, step, *arguments)`` must loop over range(first, count, step). The type of
    the first argument, an array, selects the device. The order of indices is arbitrary, so no two
    indices may write to the same place. The body may call functions of ``math`` and functions
    compiled by ``njit``.
    """
    # Division by zero gives infinity, as on a GPU. A step detects it.
    compiled = njit(error_model="numpy")(body)

    @wraps(body)
    def everywhere(count: int, *arguments: Any) -> None:
        if on_host(arguments[0]):
            compiled(0, count, 1, *arguments)
        else:
            # A run on a CPU must not import CuPy.
            from msmpetsc.backend.launcher import launcher

            launcher(body)(count, *arguments)

    # Tests call the compiled body on their own.
    everywhere.compiled = compiled  # type: ignore[attr-defined]
    return everywhere
