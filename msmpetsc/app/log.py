"""The log on stderr, which rank 0 alone writes."""

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mpi4py import MPI

LINE = "msmpetsc: %(levelname)s: %(message)s"
TIMED = "msmpetsc: %(levelname)s [%(relativeCreated).0f ms]: %(message)s"


@contextmanager
def logged_on_root(comm: "MPI.Comm", level: int = logging.INFO, timed: bool = False) -> Iterator[None]:
    """Let rank 0 alone write the log to stderr, from this level on, ``timed`` with milliseconds."""
    log = logging.getLogger("msmpetsc")
    before = log.handlers, log.level
    logging.addLevelName(logging.WARNING, "warning")
    logging.addLevelName(logging.INFO, "note")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter(TIMED if timed else LINE))
    log.handlers = [handler]
    log.setLevel(level if comm.rank == 0 else logging.CRITICAL)
    try:
        yield
    finally:
        log.handlers = before[0]
        log.setLevel(before[1])
