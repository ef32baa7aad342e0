"""Read a scene file (TOML), apply overrides, and return a checked Scene."""

import shlex
import tomllib
from collections.abc import Iterable, Mapping
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import Field, ValidationError

from msmpetsc.errors import InputError, refuse_pipe
from msmpetsc.scene.problems import as_given, problem_lines
from msmpetsc.scene.schema import SceneFile
from msmpetsc.scene.toml import overrides_of, plain

# tables of a study file that no scene file has
OF_STUDIES = {"scene", "sweep", "map"}
# endings of the mesh formats that geometry/readers.py reads
MESH_NAMES = (
    ".ply", ".mz3", ".vtu", ".vtk", ".msh", ".inp", ".bdf", ".obj", ".stl", ".off", ".glb", ".gltf",
)  # fmt: skip
# for example {"cages.count": 3000} or ["cages.count=3000"]
Changes = Mapping[str, Any] | Iterable[str]


class Scene(SceneFile):
    """A checked scene: its tables, its TOML text, and the folder that its paths start from.

    Changes are overrides as in ``--set``: values by key, with the items of a list by number
    ("pin.0.region").

    Examples
    --------
        scene = msmpetsc.Scene.load("scenes/bunny_fall.toml", {"cages.count": 3000})
        softer = scene.changed({"material.young_modulus": 2e4})
    """

    text: str = Field("", description="the TOML text, overrides included")
    folder: Path = Field(Path(), description="folder of the file")

    @classmethod
    def load(cls, path: str | PathLike[str], changes: Changes = ()) -> "Scene":
        """Return the checked scene of a file.

        Parameters
        ----------
        path : path
            Scene file (TOML).
        changes : mapping or iterable of str
            Overrides, for example {"cages.count": 3000} or ["cages.count=3000"].

        Raises
        ------
        InputError
            Has a line for each problem of the scene.
        """
        return load_scene(Path(path), changes)

    @classmethod
    def of(
        cls, tables: Mapping[str, Any], folder: str | PathLike[str] = ".", changes: Changes = ()
    ) -> "Scene":
        """Return the checked scene of tables, for example {"mesh": {"source": "body.obj"}, ...}.

        Parameters
        ----------
        tables : mapping
            Tables as in a scene file; numpy arrays stand for lists.
        folder : path
            Folder that relative paths start from. Paths may lead outside it.
        changes : mapping or iterable of str
            Overrides, as for ``load``.

        Raises
        ------
        InputError
            Has a line for each problem of the scene.
        """
        return _checked(Path(folder) / "scene", plain(tables), "", overrides_of(changes))

    def changed(self, changes: Changes) -> "Scene":
        """Return a checked copy of the scene with changes.

        Parameters
        ----------
        changes : mapping or iterable of str
            Overrides, as for ``load``.

        Raises
        ------
        InputError
            Has a line for each problem of the changed scene.
        """
        return Scene.of(tomllib.loads(self.text), self.folder, changes) if changes else self

    def __repr__(self) -> str:
        """Return title, cells, meshes, integrator and steps in one line."""
        meshes = ", ".join(mesh.source for mesh in self.meshes.values())
        cages, time = self.cages, self.time
        cells = (
            f"{cages.count} cells" if cages.cell_size is None else f"cells of {cages.cell_size:g} m"
        )
        return f"Scene({self.title!r}: {cells} of {meshes}, {time.integrator}, {time.steps} steps)"

    __str__ = __repr__


def load_scene(path: str | Path, changes: Changes = (), by_user: bool = True) -> Scene:
    """Return the checked scene of a file.

    changes : overrides, applied before the check; a bare word as a value is a string
    by_user : whether the user wrote the changes; only then they may name files outside the folder

    Raises InputError with a line for each problem of the scene.
    """
    path = Path(path)
    if path.name.lower().endswith(MESH_NAMES) and path.is_file():
        scene, mesh = (shlex.quote(str(name)) for name in (path.with_suffix(".toml"), path))
        raise InputError(f"{path}: is a mesh, no scene: msmpetsc new {scene} --mesh {mesh}")
    return scene_of(path, _read(path, "scene"), changes, by_user)


def scene_of(
    path: Path, text: str, changes: Changes = (), by_user: bool = True, to_read: bool = True
) -> Scene:
    """Return the checked scene of a text, as ``load_scene`` does for a file.

    path    : path of the scene file, for messages and for relative paths
    to_read : whether the files that the scene names will be read; if so, each must be allowed
    """
    data = _parse(path, text)
    if "mesh" not in data and not OF_STUDIES.isdisjoint(data):
        raise InputError(f"{path}: is a study, no scene: msmpetsc study {shlex.quote(str(path))}")
    overrides = overrides_of(changes)
    scene = _checked(path, data, text, overrides)
    if to_read:
        _refuse_outside(path, scene, overrides if by_user else None)
    return scene


def _checked(path: Path, data: dict[str, Any], text: str, overrides: list[str]) -> Scene:
    """Return the checked scene of data with overrides. Raises InputError."""
    for override in overrides:
        _override(data, override)
    try:
        checked = SceneFile.model_validate(data)
        # only given fields, so that an absent ``mesh`` or ``body`` stays absent
        given = {name: getattr(checked, name) for name in checked.model_fields_set}
        text = tomli_w.dumps(data) if overrides or not text else text
        return Scene(**given, text=text, folder=path.parent)
    except ValidationError as error:
        raise InputError("\n".join(problem_lines(path, error))) from None
    except RecursionError:
        raise InputError(f"{path}: its tables have too many levels") from None
    except TypeError as error:
        raise InputError(f"{path}: cannot be written as TOML: {error}") from None


def read_toml(path: Path, kind: str = "scene") -> dict[str, Any]:
    """Return the data of a TOML file. Raises InputError that calls it a ``kind`` file."""
    return _parse(path, _read(path, kind))


def _refuse_outside(path: Path, scene: SceneFile, overrides: list[str] | None) -> None:
    """Raise InputError if a file that the user did not name is outside the scene's folder.

    overrides : changes by the user; None if the changes are not the user's
    """
    for key, name in scene.named_files(overrides or ()):
        if not lies_below(path.parent, name):
            allows = "" if overrides is None else f"; --set {key}=PATH allows it"
            raise InputError(
                f"{path}: {key}: {as_given(name)} is not in the scene's folder, nor below it"
                f"{allows}"
            )


def lies_below(folder: Path, name: str) -> bool:
    """Return whether a path relative to ``folder`` stays in or below it, with links followed."""
    try:
        return (folder / name).resolve().is_relative_to(folder.resolve())
    # a loop of links, a null character, or a name that is too long
    except (OSError, RuntimeError, ValueError):
        return False


def _read(path: Path, kind: str) -> str:
    """Return the text of a file. Raises InputError that calls it a ``kind`` file."""
    refuse_pipe(path)
    try:
        # -sig drops a byte order mark, which some editors write
        return path.read_text("utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: no such {kind} file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text (byte {error.start})") from None


def _parse(path: Path, text: str) -> dict[str, Any]:
    """Return the data of a TOML text. Raises InputError that names ``path``."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not TOML: {error}") from None


def _override(data: dict[str, Any], override: str) -> None:
    """Apply an override "key.path=value" to ``data``. Raises InputError."""
    try:
        name, equals, raw = override.partition("=")
        path = tuple(int(key) if key.isdecimal() else key for key in name.strip().split("."))
        if not equals or not raw.strip() or "" in path:
            raise InputError("must read key.path=value")
        value = _override_value(raw.strip())
        container: Any = data
        for key, next_key in pairwise(path):
            empty: Any = [] if isinstance(next_key, int) else {}
            container = _put(container, key, empty, replace=False)
        _put(container, path[-1], value, replace=True)
    except InputError as error:
        raise InputError(f"--set {as_given(override)}: {error}") from None


def _override_value(raw: str) -> Any:
    """Return the value of an override: TOML, or else a bare string. Raises InputError."""
    try:
        value, *others = tomllib.loads(f"value = {raw}").values()
    except (ValueError, RecursionError):
        if raw[0] in "\"'[{":
            raise InputError("the value is not TOML") from None
        return raw
    if others:
        raise InputError("must hold a single value")
    return value


def _put(container: Any, key: str | int, value: Any, replace: bool) -> Any:
    """Return the value at ``key``, set if it is absent or ``replace``. Raises InputError."""
    if isinstance(container, dict):
        key = str(key)
        if replace or key not in container:
            container[key] = value
    elif not isinstance(container, list):
        raise InputError(
            f"{key!r} has no place in {as_given(container)}, which is no table or list"
        )
    elif not isinstance(key, int) or key > len(container):
        size = len(container)
        raise InputError(f"{key!r} is no item of a list of {size}: the next would be {size}")
    elif key == len(container):
        container.append(value)
    elif replace:
        container[key] = value
    return container[key]
