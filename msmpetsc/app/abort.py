"""Log and failures on several ranks: rank 0 writes the log; a failure on some ranks ends all."""

import logging
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from msmpetsc.errors import STATUS_BUG, STATUS_INTERRUPTED, as_expected

if TYPE_CHECKING:
    from mpi4py import MPI

# longest wait for a failure of the other ranks [s]; far above any load imbalance
PATIENCE = 10.0
LINE = "msmpetsc: %(levelname)s: %(message)s"
TIMED = "msmpetsc: %(levelname)s [%(relativeCreated).0f ms]: %(message)s"


@contextmanager
def logged_on_root(
    comm: "MPI.Comm", level: int = logging.INFO, timed: bool = False
) -> Iterator[None]:
    """Write rank 0's log, and no other rank's, to stderr during the block.

    level : least level of the lines shown
    timed : whether each line has the time since the start [ms]
    """
    log = logging.getLogger("msmpetsc")
    handlers, previous_level = log.handlers, log.level
    logging.addLevelName(logging.WARNING, "warning")
    logging.addLevelName(logging.INFO, "note")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter(TIMED if timed else LINE))
    log.handlers = [handler]
    log.setLevel(level if comm.rank == 0 else logging.CRITICAL)
    try:
        yield
    finally:
        log.handlers = handlers
        log.setLevel(previous_level)


@contextmanager
def ending_together(
    comm: "MPI.Comm", extra: str = "run", abandon: Callable[[], None] = lambda: None
) -> Iterator[None]:
    """Raise an error of the block if all ranks fail, and abort all ranks if only some fail.

    Without the abort the other ranks would wait for ever. Enter this context inside each context
    whose exit is collective (collective).

    extra   : extra named in the message if several extras bring a missing package
    abandon : called on a failing rank before the abort, which skips all cleanup
    """
    # an own communicator, so that the barrier matches no other call
    meeting = comm.Dup() if comm.size > 1 else None
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
    """Return whether all ranks fail within PATIENCE.

    The time limit grows with the rank, so that the lowest failing rank reports the error.
    """
    barrier = meeting.Ibarrier()
    until = time.monotonic() + PATIENCE * (1 + meeting.rank / meeting.size)
    while time.monotonic() < until:
        if barrier.Test():
            return True
        time.sleep(0.01)
    return False


def _end_all(comm: "MPI.Comm", line: str, status: int, abandon: Callable[[], None]) -> None:
    """Print the line and end all ranks by MPI_Abort; do nothing in a serial run."""
    if comm.size > 1:
        print(f"msmpetsc: {line}", file=sys.stderr, flush=True)
        abandon()
        comm.Abort(status)
