"""The disk below a result file: a lock against a second run, room for what is planned, errors in one line."""

import fcntl
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EACCES, EAGAIN
from pathlib import Path

from msmpetsc.errors import InputError


class Lock:
    """Held on a file beside `path` while that is written; the system itself takes it from a run that is killed."""

    def __init__(self, path: Path):
        """Take the lock. Raises InputError where another run has it."""
        self.path = path.with_name(f".{path.name}.lock")
        self._file = -1
        while not self._take(path):
            pass

    def _take(self, path: Path) -> bool:
        """Lock the file, or return False where the run that had it took its name away before it was locked.

        Another run may by then have locked a new file of that name.
        """
        self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
        try:
            fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (EACCES, EAGAIN):  # else it is a file system without locks
                os.close(self._file)
                raise InputError(f"{path} is being written by another run") from None
            return True
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(self._file), os.stat(self.path)):
                return True
        os.close(self._file)
        return False

    def free(self) -> None:
        """Give the lock back and remove its file."""
        self.path.unlink(missing_ok=True)  # while it is locked: the name is still this file's
        os.close(self._file)


def bytes_taken(path: Path) -> int:
    """Return what a file takes on the disk [byte], 0 for none."""
    return path.stat().st_blocks * 512 if path.exists() else 0


def refuse_small_disk(path: Path, planned: int) -> None:
    """Raise InputError where `planned` [byte] are not free: better now than hours later."""
    free = shutil.disk_usage(path.parent).free
    if planned > free:
        raise InputError(f"{path} will need {planned / 1e9:.3g} GB, and only {free / 1e9:.3g} GB are free there")


def copy_sparse(source: int, path: Path) -> None:
    """Copy the file of a descriptor to a new name; zeros, which frames to come are, take no room."""
    with open(path, "xb") as copy:
        for start in range(0, size := os.fstat(source).st_size, 2**20):
            if (piece := os.pread(source, 2**20, start)).strip(b"\0"):
                os.pwrite(copy.fileno(), piece, start)
        copy.truncate(size)


@contextmanager
def plain_errors(path: Path) -> Iterator[None]:
    """Turn errors of the file system into one line; HDF5 words them at length, and not always as OSError."""
    try:
        yield
    except (OSError, RuntimeError, ValueError) as error:
        message = re.search(r"error message = '([^']*)'", str(error))
        if not message and not isinstance(error, OSError):
            raise
        reason = message[1] if message else getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be written: {reason}") from error
