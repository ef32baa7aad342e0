"""One body for every index, where the arrays are: a compiled loop on the CPU, one thread an index on a GPU."""

import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import numba

from msmpetsc.backend.arrays import on_host


def cache_is_empty() -> bool:
    """Return whether numba's cache for these sources (msmpetsc/__init__.py) has no kernel's index file."""
    return not any(Path(os.environ["NUMBA_CACHE_DIR"]).rglob("*.nbi"))


def kernel(body: Callable[..., None]) -> Callable[..., None]:
    """Make of ``body(first, count, step, *arguments)``, for every i in range(first, count, step), a kernel.

    ``kernel(body)(count, *arguments)`` does the same for all i below a count, in any order.

    The first argument is an array, whose type tells where. What the body calls is compiled by
    numba.njit and takes its roots from ``math``; no two indices write to the same place. The loop
    stands in the body, and not here, so that numba finds what it has compiled before.
    """
    # A division by zero is infinite, as on a GPU: the step then tells of a number that is not finite.
    compiled = numba.njit(cache=True, error_model="numpy")(body)

    @wraps(body)
    def everywhere(count: int, *arguments: Any) -> None:
        if on_host(arguments[0]):
            compiled(0, count, 1, *arguments)
        else:
            from msmpetsc.backend.launcher import launcher  # and CuPy: a CPU's run needs neither

            launcher(body)(count, *arguments)

    everywhere.compiled = compiled  # type: ignore[attr-defined]  # for tests, which run bodies on what is no GPU
    return everywhere
