"""Scene file (TOML) and what the command line changes in it -> a checked Scene."""

import tomllib
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import ValidationError

from msmpetsc.errors import InputError
from msmpetsc.scene import Scene, SceneFile
from msmpetsc.scene_errors import as_given, problem_lines


def load_scene(path: str | Path, overrides: Iterable[str] = (), presets: Collection[str] | None = None) -> Scene:
    """Read and check a scene file.

    overrides: "key.path=value" each, as of --set: value in TOML (a bare word is a string), list items by
        number; they replace or insert before anything is checked.
    presets: the known names of solver presets; any name will do if None.

    Raises InputError naming every problem of the file, one a line.
    """
    path, overrides = Path(path), list(overrides)
    file_text, data = read_toml(path)
    keys = {_override(data, override): override for override in overrides}
    try:
        checked = SceneFile.model_validate(data, context={"presets": presets})
    except ValidationError as error:
        raise InputError("\n".join(problem_lines(path, error, file_text, keys))) from None
    return Scene(**dict(checked), text=tomli_w.dumps(data) if overrides else file_text, folder=path.parent)


def read_toml(path: Path, kind: str = "scene") -> tuple[str, dict[str, Any]]:
    """Text and data of a TOML file. Raises InputError, which calls it a ``kind`` file."""
    text = _read(path, kind)
    return text, _parse(path, text)


def _read(path: Path, kind: str) -> str:
    try:
        return path.read_bytes().decode("utf-8-sig")  # -sig: some editors start the file with a byte order mark
    except FileNotFoundError:
        raise InputError(f"{path}: no such {kind} file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder, not a {kind} file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text (byte {error.start})") from None


def _parse(path: Path, text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        last = text.rstrip().count("\n") + 1
        problem = str(error).replace("at end of document", f"at the end, line {last}")
        raise InputError(f"{path}: is not TOML: {problem}") from None
    except RecursionError:
        raise InputError(f"{path}: is nested too deeply") from None
    except ValueError:  # all that tomllib leaves to int(): Python's limit on digits
        raise InputError(f"{path}: has an integer of too many digits") from None


def _override(data: dict[str, Any], override: str) -> tuple[str | int, ...]:
    """Carry out one "key.path=value" in ``data``; returns the key path."""
    try:
        name, equals, raw = override.partition("=")
        path = tuple(int(key) if key.isdecimal() and len(key) < 10 else key for key in name.strip().split("."))
        if not equals or not raw.strip() or "" in path:
            raise InputError("must read key.path=value")
        value = _override_value(raw.strip())
        holder: Any = data
        for key, following in zip(path, path[1:], strict=False):
            empty = [] if isinstance(following, int) else {}
            holder = _put(holder, key, empty, replace=False)
        _put(holder, path[-1], value, replace=True)
    except InputError as error:
        raise InputError(f"--set {as_given(override)}: {error}") from None
    return path


def _override_value(raw: str) -> Any:
    try:
        parsed = tomllib.loads(f"value = {raw}")
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
        raise InputError(f"{key!r} is no item of a list of {len(holder)}: the next would be {len(holder)}")
    elif key == len(holder):
        holder.append(value)
    elif replace:
        holder[key] = value
    return holder[key]
