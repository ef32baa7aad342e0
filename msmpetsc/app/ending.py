"""What all ranks say together: the log, which rank 0 alone writes; and one line and one exit status when some fail."""

import logging
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from msmpetsc.errors import as_expected

if TYPE_CHECKING:
    from mpi4py import MPI

STATUS_BUG, STATUS_INTERRUPTED = 1, 130
PATIENCE = 10.0  # [s] that ranks may come to the same failure one after the other
LINE = "msmpetsc: %(levelname)s: %(message)s"
TIMED = "msmpetsc: %(levelname)s [%(relativeCreated).0f ms]: %(message)s"


@contextmanager
def logged_on_root(
    comm: "MPI.Comm", level: int = logging.INFO, timed: bool = False
) -> Iterator[None]:
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


@contextmanager
def ending_together(
    comm: "MPI.Comm",
    extra: str = "run",
    abandon: Callable[[], None] = lambda: None,
) -> Iterator[None]:
    """Let a failure of all ranks in the block pass, and end all ranks at a failure of some (collective to enter).

    The other ranks would wait for ever. The block stands within each context whose exit is collective.

    extra   : the extra that an error names if it brings a package that is missing
    abandon : called on a failing rank before it ends all ranks, as no context is left then
    """
    meeting = comm.Dup() if comm.size > 1 else None  # its messages meet no others
    try:
        yield
    except KeyboardInterrupt:
        _end_all(comm, f"rank {comm.rank}: interrupted", STATUS_INTERRUPTED, abandon)
        raise
    except Exception as raised:
        error = as_expected(raised, extra)
        if error is None:
            _end_all(comm, f"rank {comm.rank}: {traceback.format_exc()}", STATUS_BUG, abandon)
            raise
        if meeting is not None and not error.on_all_ranks:
            if not _all_fail(meeting):
                _end_all(comm, f"error: {error}", error.exit_status, abandon)
            error.on_all_ranks = True
        raise error from raised
    if meeting is not None:
        meeting.Free()


def _all_fail(meeting: "MPI.Comm") -> bool:
    """Return whether all ranks fail, as soon as they do or when patience ends.

    That of a low rank ends first: it tells, and ends the others.
    """
    barrier = meeting.Ibarrier()
    until = time.monotonic() + PATIENCE * (1 + meeting.rank / meeting.size)
    while time.monotonic() < until:
        if barrier.Test():
            return True
        time.sleep(0.01)
    return False


def _end_all(comm: "MPI.Comm", line: str, status: int, abandon: Callable[[], None]) -> None:
    """Print the line and end all ranks by MPI_Abort; a run of one rank ends by itself."""
    if comm.size > 1:
        print(f"msmpetsc: {line}", file=sys.stderr, flush=True)
        abandon()
        comm.Abort(status)
