"""Files on disk: atomic writes, a lock, checks of free space, and errors in one line."""

import fcntl
import io
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EACCES, EAGAIN
from itertools import count
from pathlib import Path
from typing import Any

from msmpetsc.errors import InputError, one_line

PARTS = (
    count()
)  # numbers of parts: several threads write, and USD remembers the name of what failed
LONGEST_STEM = (
    50  # letters of a name that its part keeps: with more it could be too long for the file system
)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary name to write to; the file gets its own name only when it is complete.

    That name ends alike, for many writers go by the ending. Links are followed; a file that is
    replaced keeps its rights, and one that may not be written stays. Every file that a command
    leaves is written so, but for results, which grow (results.writer).

    Raises InputError, with the path and the system's reason in one line.
    """
    real = Path(os.path.realpath(path))
    part = real.with_name(
        f".{real.stem[:LONGEST_STEM]}.{os.getpid()}-{next(PARTS)}.part{real.suffix}"
    )
    try:
        with plain_errors(path):
            refuse_no_file(path)
            real.parent.mkdir(parents=True, exist_ok=True)
            if real.exists():
                open(real, "r+b").close()
            yield part
            with open(part, "r+b") as file:
                os.fsync(file.fileno())  # some file systems say only now that they are full
            if real.exists():
                shutil.copymode(real, part)
            part.replace(real)
    finally:
        with suppress(OSError):  # of a folder that is none
            part.unlink(missing_ok=True)


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a text or bytes as one complete file. Raises InputError."""
    with whole_file(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def refuse_no_file(path: Path) -> None:
    """Raise InputError for the name of a folder, a pipe or a device."""
    if path.is_dir():
        raise InputError(f"{path} is a folder, not a file")
    if path.exists() and not path.is_file():
        raise InputError(f"{path} is a pipe or a device, not a file")


class Storage(io.FileIO):
    """A file that HDF5 writes to, which keeps write errors back: HDF5 crashes on them as it ends.

    failure : the first, to be raised by who writes
    """

    failure: OSError | None = None

    def write(self, data: Any) -> int:
        """Write all data at the file's present position."""
        left = memoryview(data).cast("B")
        try:
            while len(left):
                left = left[super().write(left) :]
        except OSError as error:
            self.failure = self.failure or error
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        """Set the length of the file [byte]."""
        try:
            return super().truncate(size)
        except OSError as error:
            self.failure = self.failure or error
            return size or 0

    @contextmanager
    def telling(self) -> Iterator[None]:
        """Raise the first write error after the block, whatever HDF5 made of it."""
        try:
            yield
        finally:
            if self.failure is not None:
                raise self.failure


class Lock:
    """A lock on a file beside `path` during writing; the system frees it when a run is killed."""

    def __init__(self, path: Path):
        """Take the lock. Raises InputError where another run has it."""
        self.path = path.with_name(f".{path.name}.lock")
        while True:
            self._file = os.open(
                self.path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC, 0o666
            )
            try:
                fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno in (EACCES, EAGAIN):
                    os.close(self._file)
                    raise InputError(f"{path} is being written by another run") from None
                return  # a file system without locks
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(self._file), os.stat(self.path)):
                    return
            os.close(
                self._file
            )  # who had it took its name away meanwhile: another run may have locked a new one

    def free(self) -> None:
        """Free the lock and remove its file."""
        unlink_inode(self.path, self.inode)
        os.close(self._file)

    @property
    def inode(self) -> int:
        """Return the number of the lock's file in its file system."""
        return os.fstat(self._file).st_ino


def unlink_inode(path: Path, inode: int) -> None:
    """Remove the name ``path`` if it still belongs to the file of this inode."""
    with suppress(OSError):
        if path.stat().st_ino == inode:
            path.unlink()


def refuse_small_disk(path: Path, planned: int) -> None:
    """Raise InputError where the disk has no room for `planned` bytes, less what the file takes."""
    free = shutil.disk_usage(path.parent).free
    needed = planned - (path.stat().st_blocks * 512 if path.exists() else 0)
    if needed > free:
        raise InputError(
            f"{path} will need {needed / 1e9:.3g} GB, and only {free / 1e9:.3g} GB are free there"
        )


@contextmanager
def plain_errors(path: Path) -> Iterator[None]:
    """Turn errors of the file system, and HDF5's wording of them, into one line's InputError."""
    try:
        yield
    except (OSError, RuntimeError, ValueError) as error:
        message = re.search(r"error message = '([^']*)'", str(error))
        if not message and not isinstance(error, OSError):
            raise
        reason = message[1] if message else getattr(error, "strerror", None) or one_line(error)
        raise InputError(f"{path} cannot be written: {reason}") from error
