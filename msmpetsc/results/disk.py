"""Write files to disk: atomically, under a lock, with checks of free space and plain errors."""

import fcntl
import io
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EACCES, EAGAIN
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from msmpetsc.errors import InputError, one_line, refuse_pipe


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a path in a temporary folder; move the file to ``path`` when it is complete.

    Links are followed. A replaced file keeps its permissions, and a read-only file stays. All
    output files are written this way, except results, which grow (results.writer).

    Raises InputError, with the path and the system's reason in a single line.
    """
    real = Path(os.path.realpath(path))
    with plain_errors(path):
        refuse_no_file(path)
        real.parent.mkdir(parents=True, exist_ok=True)
        refuse_read_only(real)
        with TemporaryDirectory(prefix=".part-", dir=real.parent) as folder:
            part = Path(folder, real.name)
            yield part
            with open(part, "r+b") as file:
                # some file systems report only here that they are full
                os.fsync(file.fileno())
            if real.exists():
                shutil.copymode(real, part)
            part.replace(real)


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a text or bytes as a complete file. Raises InputError."""
    with whole_file(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def refuse_no_file(path: Path) -> None:
    """Raise InputError if the path is a folder, a pipe or a device."""
    if path.is_dir():
        raise InputError(f"{path} is a folder, not a file")
    refuse_pipe(path)


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Raise InputError if the path is no file, or a file that may not be replaced."""
    refuse_no_file(path)
    if path.exists() and not overwrite:
        raise InputError(f"{path} exists: --overwrite replaces it")


def refuse_read_only(path: Path) -> None:
    """Raise OSError for an existing file that cannot be written."""
    if path.exists():
        open(path, "r+b").close()


class Storage(io.FileIO):
    """File for HDF5 that keeps write errors instead of raising them.

    HDF5 crashes at exit if its driver raises an error.

    failure : the first write error, for the writer to raise
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
    def reporting_errors(self) -> Iterator[None]:
        """Raise the first write error after the block, in place of HDF5's own error."""
        try:
            yield
        finally:
            if self.failure is not None:
                raise self.failure


class Lock:
    """Lock of a file that is being written; the system releases the lock if the run is killed."""

    def __init__(self, path: Path):
        """Take the lock. Raises InputError if another run holds it."""
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
                # the file system has no locks
                return
            if is_named(self._file, self.path):
                return
            # the last holder has removed the name: another run may lock a new file
            os.close(self._file)

    def close(self) -> None:
        """Release the lock and remove its file."""
        unlink_inode(self.path, self.inode)
        os.close(self._file)

    @property
    def inode(self) -> int:
        """Inode number of the lock's file."""
        return os.fstat(self._file).st_ino


def is_named(file: int, path: Path) -> bool:
    """Return whether the path names the open file of a descriptor."""
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except FileNotFoundError:
        return False


def unlink_inode(path: Path, inode: int) -> None:
    """Remove the name ``path`` if it still belongs to the file of this inode."""
    with suppress(OSError):
        if path.stat().st_ino == inode:
            path.unlink()


def refuse_small_disk(path: Path, planned: int) -> None:
    """Raise InputError if ``planned`` bytes, less the present size, exceed the free space."""
    free = shutil.disk_usage(path.parent).free
    needed = planned - (path.stat().st_blocks * 512 if path.exists() else 0)
    if needed > free:
        raise InputError(
            f"{path} will need {needed / 1e9:.3g} GB, and only {free / 1e9:.3g} GB are free there"
        )


@contextmanager
def plain_errors(path: Path) -> Iterator[None]:
    """Turn errors of the file system into an InputError of a single line."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or one_line(error)
        raise InputError(f"{path} cannot be written: {reason}") from error
