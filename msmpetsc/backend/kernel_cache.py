"""Cache of compiled kernels on disk, for all processes that run the same sources.

It replaces numba's cache, which checks only the kernel's own file for changes, fails in read-only
directories, and lets two processes mix up their files.

- The name of a directory contains a digest of all sources with kernels.
- The name of a file is a digest of the kernel, its argument types and the constants that it reads.
"""

import hashlib
import inspect
import os
import pickle
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
# size of a test file [byte]; a full disk may still accept a few bytes
PROBE = 1 << 16
# size of the digest at the start of a file [byte]; it detects damaged files
CHECK = hashlib.sha256().digest_size


def _digest_of_sources() -> str:
    """Return a digest of all sources with kernels and of the compilers' versions."""
    sources = [path.read_bytes() for path in sorted(PACKAGE.rglob("*.py"))]
    kernels = [source for source in sources if b"njit" in source or b"@kernel" in source]
    versions = f"{msmpetsc.__version__} {numba.__version__} {sys.implementation.cache_tag}"
    return hashlib.sha256(b"".join(kernels) + versions.encode()).hexdigest()[:16]


# Computed before kernels are imported: if the package is updated during a run, kernels
# of the old sources must not be stored under the new digest.
SOURCES = _digest_of_sources()


def _candidates() -> Iterator[Path]:
    """Yield the candidates for the cache directory: the user's choice, the package, home."""
    own = f"msmpetsc-kernels-{os.getuid()}-{SOURCES}"
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        yield Path(chosen) / own
    yield PACKAGE / "__pycache__" / f"kernels-{SOURCES}"
    # Path.home() raises RuntimeError for a user without a home directory.
    with suppress(RuntimeError):
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / own


@cache
def folders() -> tuple[list[Path], Path | None]:
    """Return the cache directories to read, and the directory to write; None if there is none."""
    readable = []
    for folder in map(Path.absolute, _candidates()):
        with suppress(OSError):
            folder.mkdir(0o755, parents=True, exist_ok=True)
            readable.append(folder)
            with tempfile.TemporaryFile(dir=folder) as file:
                file.write(bytes(PROBE))
            return readable, folder
    return readable, None


def writable() -> Path | None:
    """Return the cache directory to write; None if each process must compile its own kernels."""
    return folders()[1]


def is_empty() -> bool:
    """Return whether the cache has no kernel of these sources."""
    return not any(any(folder.iterdir()) for folder in folders()[0])


def load(name: str) -> bytes | None:
    """Return the data stored under a name; None if there is no file, or a damaged file."""
    for folder in folders()[0]:
        with suppress(OSError):
            content = (folder / _file(name)).read_bytes()
            if content[:CHECK] == hashlib.sha256(content[CHECK:]).digest():
                return content[CHECK:]
    return None


def save(name: str, data: bytes) -> None:
    """Store data under a name, if the disk has room. The write is atomic for other processes."""
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
    """Cache of a function's machine code by signature, with the interface of numba's caches."""

    def __init__(self, function: Callable[..., Any]):
        self._function = function

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the compiled function of a signature; None if the cache does not have it."""
        target.refresh()
        kept = load(self._key(signature, target.codegen()))
        if kept is None:
            return None
        return CompileResult._rebuild(target, *pickle.loads(kept))  # type: ignore[no-untyped-call]

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Store the compiled function of a signature, unless it holds addresses of this process."""
        if not compiled.library.has_dynamic_globals:
            data = dumps(compiled._reduce())  # type: ignore[no-untyped-call]
            save(self._key(signature, compiled.codegen), data)

    def _key(self, signature: Any, codegen: Any) -> str:
        return key(self._function, signature, codegen.magic_tuple())


def key(function: Callable[..., Any], types: Iterable[Any], target: object) -> str:
    """Return the cache key of a function for argument types and a target processor."""
    constants = sorted(_constants(function).items())
    return repr(
        (function.__module__, function.__qualname__, target, [*map(_described, types)], constants)
    )


def _described(kind: Any) -> tuple[Any, ...]:
    """Return the name of a numba type, and the fields of named tuples, which the name lacks."""
    return (
        str(kind),
        getattr(kind, "fields", ()),
        [_described(item) for item in getattr(kind, "types", ())],
    )


@cache
def _constants(function: Callable[..., Any]) -> dict[str, bytes]:
    """Return the pickled constants, by name, that a function and the kernels it calls read."""
    variables = inspect.getclosurevars(function)
    constants: dict[str, bytes] = {}
    for name, value in {**variables.globals, **variables.nonlocals}.items():
        if kernel := getattr(value, "py_func", None):
            constants |= _constants(kernel)
        elif not isinstance(value, ModuleType):
            place = f"{function.__module__}.{function.__qualname__}.{name}"
            constants[place] = pickle.dumps((value, getattr(value, "_fields", ())))
    return constants
