"""Says when a run waits for numba to compile: at the first kernel that its cache does not have."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from numba.core.event import Event, Listener, install_listener

from msmpetsc.comm import log


def cache_is_empty() -> bool:
    """Return whether numba's cache for these sources (msmpetsc/__init__.py) has no index file.

    Each kernel has one. To be asked before kernels are called, which writes them.
    """
    return not any(Path(os.environ["NUMBA_CACHE_DIR"]).rglob("*.nbi"))


class FirstCompilation(Listener):
    """Logs the first compilation of a kernel of ours. Numba announces one only where its cache has nothing to load."""

    def __init__(self, all_are_new: bool):
        self._all_are_new, self._logged = all_are_new, False

    def on_start(self, event: Event) -> None:
        kernel = event.data["dispatcher"]
        if self._logged or not kernel.py_func.__module__.startswith("msmpetsc.") or not kernel.stats.cache_path:
            return
        self._logged = True
        log.info("compiling kernels, once%s", ", about a minute" if self._all_are_new else "")

    def on_end(self, event: Event) -> None:
        pass


@contextmanager
def compilation_logged() -> Iterator[None]:
    """Log the first compilation within this block."""
    with install_listener("numba:compile", FirstCompilation(cache_is_empty())):
        yield
