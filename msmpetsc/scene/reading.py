"""Scene file (TOML) and what the command line changes in it -> a checked Scene."""

import shlex
import tomllib
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import Field, ValidationError

from msmpetsc.errors import InputError
from msmpetsc.scene.problems import KeyPath, as_given, problem_lines
from msmpetsc.scene.schema import SceneFile
from msmpetsc.scene.toml import DEEPEST, overrides_of, plain, toml_of

OF_STUDIES = {"scene", "sweep", "map"}  # tables that a study has and a scene has not
MESHES = (  # those of geometry/readers.py
    ".ply", ".mz3", ".vtu", ".vtk", ".msh", ".inp", ".bdf", ".obj", ".stl", ".off", ".glb", ".gltf",
)  # fmt: skip
Changes = Mapping[str, Any] | Iterable[str]  # {"cages.count": 3000}, or ["cages.count=3000"]
LONGEST = 2**24  # [byte] of a scene: painted points may stand in it by their numbers


class Scene(SceneFile):
    """A scene as read: its tables, its TOML text as run, and the folder its paths start from.

        scene = msmpetsc.Scene.load("scenes/bunny_fall.toml", {"cages.count": 3000})
        softer = scene.changed({"material.young_modulus": 2e4})

    Changes are those of ``--set``: any key of a scene, items of lists by number ("pin.0.region").
    """

    text: str = Field("", description="the TOML text, overrides included")
    folder: Path = Field(Path(), description="folder of the file")

    @classmethod
    def load(cls, path: str | PathLike[str], changes: Changes = ()) -> "Scene":
        """Read a scene file. Raises InputError naming every problem, one a line."""
        return load_scene(Path(path), changes)

    @classmethod
    def of(
        cls, tables: Mapping[str, Any], folder: str | PathLike[str] = ".", changes: Changes = ()
    ) -> "Scene":
        """Make a scene of tables as a file would have them: {"mesh": {"source": "body.obj"}, ...}.

        folder : where the paths that it names start; they may lead anywhere, and numpy's arrays stand for lists

        Raises InputError naming every problem, one a line.
        """
        path = Path(folder) / "scene"
        data = plain(tables)
        keys = {_override(data, override): override for override in overrides_of(changes)}
        checked = _checked(path, data, "", keys)
        try:
            return Scene(**_given(checked), text=tomli_w.dumps(data), folder=path.parent)
        except TypeError as error:
            raise InputError(f"{path}: cannot be written as TOML: {error}") from None

    def changed(self, changes: Changes) -> "Scene":
        """Return this scene with changes, checked as a whole. Raises InputError."""
        return Scene.of(toml_of(self.text), self.folder, changes) if changes else self

    def __repr__(self) -> str:
        """Return one line: title, meshes, cells, integrator and steps; ``text`` has all of it."""
        meshes = ", ".join(mesh.source for mesh in self.meshes.values())
        cages, time = self.cages, self.time
        cells = (
            f"{cages.count} cells" if cages.cell_size is None else f"cells of {cages.cell_size:g} m"
        )
        return f"Scene({self.title!r}: {cells} of {meshes}, {time.integrator}, {time.steps} steps)"

    __str__ = __repr__


def load_scene(path: str | Path, changes: Changes = (), by_user: bool = True) -> Scene:
    """Read and check a scene file.

    changes : a value in TOML may be a bare word, which is a string; they replace or insert before anything is checked
    by_user : whether the changes are a user's own words, which may name files outside the folder; a file's may not

    Raises InputError naming every problem of the file, one a line.
    """
    path = Path(path)
    if path.name.lower().endswith(MESHES) and path.is_file():
        scene, mesh = (shlex.quote(str(name)) for name in (path.with_suffix(".toml"), path))
        raise InputError(f"{path}: is a mesh, no scene: msmpetsc new {scene} --mesh {mesh}")
    return scene_of(path, _read(path, "scene"), changes, by_user)


def scene_of(
    path: Path, text: str, changes: Changes = (), by_user: bool = True, to_read: bool = True
) -> Scene:
    """Check the text of a scene file as ``load_scene`` does the file.

    to_read : whether the files that it names are to be read
    """
    data = _parse(path, text)
    if "mesh" not in data and not OF_STUDIES.isdisjoint(data):
        raise InputError(f"{path}: is a study, no scene: msmpetsc study {shlex.quote(str(path))}")
    keys = {_override(data, override): override for override in overrides_of(changes)}
    checked = _checked(path, data, text, keys)
    if to_read:
        _refuse_outside(path, checked, keys if by_user else None)
    return Scene(**_given(checked), text=tomli_w.dumps(data) if keys else text, folder=path.parent)


def _given(scene: SceneFile) -> dict[str, Any]:
    """Return the tables that a scene has: of mesh and body it has but one."""
    return {name: getattr(scene, name) for name in scene.model_fields_set}


def _checked(path: Path, data: dict[str, Any], text: str, keys: dict[KeyPath, str]) -> SceneFile:
    """Return the tables checked; of a problem InputError names the line of ``text`` or the override of these keys."""
    try:
        return SceneFile.model_validate(data)
    except ValidationError as error:
        raise InputError("\n".join(problem_lines(path, error, text, keys))) from None


def read_toml(path: Path, kind: str = "scene") -> tuple[str, dict[str, Any]]:
    """Return text and data of a TOML file. Raises InputError, which calls it a ``kind`` file."""
    text = _read(path, kind)
    return text, _parse(path, text)


def _refuse_outside(path: Path, scene: SceneFile, given: Collection[KeyPath] | None) -> None:
    """Raise InputError if the scene names a file outside its folder, links followed, that the user did not name.

    given : keys of the user's own words; None where a user cannot give any
    """
    for keys, name in scene.named_files():
        if any(keys[: len(own)] == own for own in given or ()) or lies_below(path.parent, name):
            continue
        key = ".".join(map(str, keys))
        allows = "" if given is None else f"; --set {key}=PATH allows it"
        raise InputError(
            f"{path}: {key}: {as_given(name)} is not in the scene's folder, nor below it{allows}"
        )


def lies_below(folder: Path, name: str) -> bool:
    """Return whether a path from ``folder`` leads to what lies in it, links followed."""
    path = folder / name
    try:
        with suppress(
            FileNotFoundError, NotADirectoryError, PermissionError
        ):  # whoever opens it says so
            path.resolve(strict=True)  # from Python 3.13 on a loop of links is an error only so
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):  # a loop of links, a null character, a long name
        return False


def _read(path: Path, kind: str) -> str:
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            raise InputError(f"{path}: is a pipe or a device, not a {kind} file")
        with open(path, "rb") as file:
            content = file.read(LONGEST + 1)
        if len(content) > LONGEST:
            raise InputError(
                f"{path}: is too long for a {kind} file: more than {LONGEST / 2**20:g} MiB"
            )
        return content.decode("utf-8-sig")  # -sig: some editors begin with a byte order mark
    except FileNotFoundError:
        raise InputError(f"{path}: no such {kind} file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder, not a {kind} file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text (byte {error.start})") from None
    except ValueError:
        raise InputError(f"{as_given(str(path))}: no path has a null character") from None


def _parse(path: Path, text: str) -> dict[str, Any]:
    try:
        return toml_of(text)
    except tomllib.TOMLDecodeError as error:
        last = text.rstrip().count("\n") + 1
        problem = str(error).replace("at end of document", f"at the end, line {last}")
        raise InputError(f"{path}: is not TOML: {problem}") from None
    except RecursionError:
        raise InputError(f"{path}: is nested too deeply") from None
    except ValueError:  # all that tomllib leaves to int(): Python's limit on digits
        raise InputError(f"{path}: has an integer of too many digits") from None


def _override(data: dict[str, Any], override: str) -> KeyPath:
    """Carry out a "key.path=value" in ``data``; returns the key path."""
    try:
        if any("\ud800" <= letter <= "\udfff" for letter in override):  # bytes that are no text
            raise InputError("is not UTF-8 text")
        name, equals, raw = override.partition("=")
        path = tuple(
            int(key) if key.isdecimal() and len(key) < 10 else key
            for key in name.strip().split(".")
        )
        if not equals or not raw.strip() or "" in path:
            raise InputError("must read key.path=value")
        if len(path) > DEEPEST:
            raise InputError("is nested too deeply")
        value = _override_value(raw.strip())
        holder: Any = data
        for key, following in pairwise(path):
            empty: Any = [] if isinstance(following, int) else {}
            holder = _put(holder, key, empty, replace=False)
        _put(holder, path[-1], value, replace=True)
    except InputError as error:
        raise InputError(f"--set {as_given(override)}: {error}") from None
    return path


def _override_value(raw: str) -> Any:
    try:
        parsed = toml_of(f"value = {raw}")
    except (ValueError, RecursionError):
        if raw[0] in "\"'[{" or "\n" in raw:
            raise InputError("the value is not TOML") from None
        return raw
    if set(parsed) != {"value"}:
        raise InputError("must hold a single value")
    return parsed["value"]


def _put(holder: Any, key: str | int, value: Any, replace: bool) -> Any:
    """Put ``value`` at ``key`` of a table or list (where absent, or ``replace``); returns what is there then."""
    if isinstance(holder, dict):
        key = str(key)
        if replace or key not in holder:
            holder[key] = value
    elif not isinstance(holder, list):
        raise InputError(f"{key!r} has no place in {as_given(holder)}, which is no table or list")
    elif not isinstance(key, int) or key > len(holder):
        raise InputError(
            f"{key!r} is no item of a list of {len(holder)}: the next would be {len(holder)}"
        )
    elif key == len(holder):
        holder.append(value)
    elif replace:
        holder[key] = value
    return holder[key]
