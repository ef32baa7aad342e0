"""A cache of slow preparing steps: the same step of the same mesh makes the same mesh, so it is computed once.

Only large meshes are kept: a scan of 70,000 triangles takes seconds to repair, a small mesh less than a file to read.
"""

import hashlib
import json
import os
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import distributions
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import pooch

from msmpetsc.geometry.surface import Surface

LEAST_TRIANGLES = 20_000
MOST_FILES = 32  # of some megabytes each; the ones that were not used for longest go first
LIBRARIES = ("fast-simplification", "manifold3d", "numpy", "pymeshfix", "scipy")


def cached(step: Callable[..., Surface], surface: Surface, *values: object) -> Surface:
    """Return what the step makes of the surface, from the cache where it was computed before.

    step   : a function of its arguments alone
    values : of JSON's types
    """
    if len(surface.triangles) < LEAST_TRIANGLES:
        return step(surface, *values)
    path = Path(pooch.os_cache("msmpetsc")) / "prepared" / f"{_key(step, surface, values)}.npz"
    with suppress(OSError, ValueError, KeyError, EOFError, BadZipFile):  # not there, or damaged
        with np.load(path) as arrays:
            result = Surface(arrays["points"], arrays["triangles"])
        os.utime(path)
        return result
    result = step(surface, *values)
    with suppress(OSError):  # a full disk, a home that cannot be written: it is a cache
        _store(path, result)
    return result


def _key(step: Callable[..., Surface], surface: Surface, values: tuple[object, ...]) -> str:
    """Return a hash of all that the result depends on: mesh, step, values, our sources and the libraries."""
    versions = [package.version for name in LIBRARIES for package in distributions(name=name)]
    digest = hashlib.sha256(json.dumps([step.__name__, values, versions]).encode())
    for array in (surface.points, surface.triangles):
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(array.tobytes())
    for source in ("prepare.py", "surface.py"):
        digest.update((Path(__file__).parent / source).read_bytes())
    return digest.hexdigest()


def _store(path: Path, surface: Surface) -> None:
    """Write under another name first: a process that reads meanwhile finds all or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            np.savez(file, points=surface.points, triangles=surface.triangles)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    for old in sorted(path.parent.glob("*.npz"), key=lambda file: file.stat().st_mtime)[:-MOST_FILES]:
        old.unlink(missing_ok=True)
