"""One body for every index, where the arrays are: a compiled loop on the CPU, one thread an index on a GPU."""

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import numba

from msmpetsc.backend.arrays import on_host
from msmpetsc.backend.kernel_cache import KernelCache

Function = TypeVar("Function", bound=Callable[..., Any])


def njit(**options: Any) -> Callable[[Function], Function]:
    """Compile a function as ``numba.njit(**options)`` does, and keep its machine code for later processes."""

    def compiled(function: Function) -> Function:
        dispatcher: Any = numba.njit(**options)(function)
        dispatcher._cache = KernelCache(function)
        return dispatcher  # type: ignore[no-any-return]

    return compiled


def kernel(body: Callable[..., None]) -> Callable[..., None]:
    """Make of ``body(first, count, step, *arguments)``, for every i in range(first, count, step), a kernel.

    ``kernel(body)(count, *arguments)`` does the same for all i below a count, in any order.

    The first argument is an array, whose type tells where. The body calls functions compiled by ``njit``
    and takes its roots from ``math``; no two indices write to the same place. The loop stands in the
    body, and not here, so that its machine code is found again.
    """
    # A division by zero is infinite, as on a GPU: the step then tells of a number that is not finite.
    compiled = njit(error_model="numpy")(body)

    @wraps(body)
    def everywhere(count: int, *arguments: Any) -> None:
        if on_host(arguments[0]):
            compiled(0, count, 1, *arguments)
        else:
            from msmpetsc.backend.launcher import launcher  # and CuPy: a CPU's run needs neither

            launcher(body)(count, *arguments)

    everywhere.compiled = compiled  # type: ignore[attr-defined]  # for tests, which run bodies on what is no GPU
    return everywhere
