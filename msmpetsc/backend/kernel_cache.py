"""Compiled kernels on disk: found by later processes of the same sources, never by changed ones.

numba's own cache looks for changes in a kernel's file alone, fails where nothing can be written, and lets two processes
mix up their files. Here a folder's name has a digest of all sources with kernels, and a file's name one of the kernel,
its arguments and the constants that it reads. The files hold code: no folder is read that somebody else may write to.
"""

import hashlib
import inspect
import os
import pickle
import stat
import sys
import tempfile
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

import msmpetsc

PACKAGE = Path(msmpetsc.__file__).parent
PROBE = (
    1 << 16
)  # [byte] that a folder must take to be written to; a full disk may still take some bytes
CHECK = hashlib.sha256().digest_size  # [byte] at the start of a file, a digest of the rest


def _digest_of_sources() -> str:
    """Return a digest of all sources that have kernels and of the versions that compile them."""
    sources = [path.read_bytes() for path in sorted(PACKAGE.rglob("*.py"))]
    kernels = [source for source in sources if b"njit" in source or b"@kernel" in source]
    versions = f"{msmpetsc.__version__} {numba.__version__} {sys.implementation.cache_tag}"
    return hashlib.sha256(b"".join(kernels) + versions.encode()).hexdigest()[:16]


# read before the kernels are imported: an update during a run must not name them after its own sources
SOURCES = _digest_of_sources()


def _candidates() -> Iterator[Path]:
    """Yield the folders that may hold kernels: the user's choice, the package's, the home's, a temporary one."""
    own = f"msmpetsc-kernels-{os.getuid()}-{SOURCES}"
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        yield Path(chosen) / own
    yield PACKAGE / "__pycache__" / f"kernels-{SOURCES}"
    with suppress(RuntimeError):  # a user without a home
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / own
    with suppress(FileNotFoundError):
        yield Path(tempfile.gettempdir()) / own


def _is_safe(folder: Path) -> bool:
    """Return whether this user, root or the owner of the package alone may write to a folder."""
    status = folder.lstat()
    is_ours = status.st_uid in (os.getuid(), 0, PACKAGE.stat().st_uid)
    return (
        stat.S_ISDIR(status.st_mode)
        and is_ours
        and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    )


@cache
def folders() -> tuple[list[Path], Path | None]:
    """Return the folders to look for kernels in, and the last of them if it can be written."""
    safe = []
    for folder in map(Path.absolute, _candidates()):
        with suppress(OSError):
            folder.mkdir(0o755, parents=True, exist_ok=True)
            if _is_safe(folder):
                safe.append(folder)
                with tempfile.TemporaryFile(dir=folder) as file:
                    file.write(bytes(PROBE))
                return safe, folder
    return safe, None


def writable() -> Path | None:
    """Return the folder that kernels are kept in; None if each process must compile its own."""
    return folders()[1]


def is_empty() -> bool:
    """Return whether no kernel of these sources is kept."""
    return not any(any(folder.iterdir()) for folder in folders()[0])


def load(name: str) -> bytes | None:
    """Return what is kept under a name; None if nothing is, or if its file is damaged."""
    for folder in folders()[0]:
        with suppress(OSError):
            content = (folder / _file(name)).read_bytes()
            if content[:CHECK] == hashlib.sha256(content[CHECK:]).digest():
                return content[CHECK:]
    return None


def save(name: str, data: bytes) -> None:
    """Keep data under a name, if the disk has room: other processes see the whole file or none."""
    if folder := writable():
        new = folder / f"{uuid.uuid4().hex}.part"
        try:
            new.write_bytes(hashlib.sha256(data).digest() + data)
            new.replace(folder / _file(name))
        except OSError:
            with suppress(OSError):
                new.unlink()


def _file(name: str) -> str:
    return hashlib.sha256(name.encode()).hexdigest()[:32]


class KernelCache(NullCache):
    """A function's machine code for each of its signatures, as numba's dispatcher asks for it."""

    def __init__(self, function: Callable[..., Any]):
        self._function = function

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the compiled function of a signature, if it is kept."""
        target.refresh()
        kept = load(self._key(signature, target.codegen()))
        if kept is None:
            return None
        return CompileResult._rebuild(target, *pickle.loads(kept))  # type: ignore[no-untyped-call]

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep the compiled function of a signature, unless it holds addresses of this process."""
        if not compiled.library.has_dynamic_globals:
            data = dumps(compiled._reduce())  # type: ignore[no-untyped-call]
            save(self._key(signature, compiled.codegen), data)

    def _key(self, signature: Any, codegen: Any) -> str:
        return key(self._function, signature, codegen.magic_tuple())


def key(function: Callable[..., Any], types: Iterable[Any], target: object) -> str:
    """Return the key of a function, compiled for arguments of these types and for a processor."""
    constants = sorted(_constants(function).items())
    return repr(
        (function.__module__, function.__qualname__, target, [*map(_described, types)], constants)
    )


def _described(kind: Any) -> tuple[Any, ...]:
    """Return the name of a type with the fields of named tuples, which numba's name of it lacks."""
    return (
        str(kind),
        getattr(kind, "fields", ()),
        [_described(one) for one in getattr(kind, "types", ())],
    )


@cache
def _constants(function: Callable[..., Any]) -> dict[str, bytes]:
    """Return the constants that a function and the kernels it calls read, by name."""
    read = inspect.getclosurevars(function)
    found: dict[str, bytes] = {}
    for name, value in {**read.globals, **read.nonlocals}.items():
        if kernel := getattr(value, "py_func", None):
            found |= _constants(kernel)
        elif not isinstance(value, ModuleType):
            place = f"{function.__module__}.{function.__qualname__}.{name}"
            found[place] = pickle.dumps((value, getattr(value, "_fields", ())))
    return found
