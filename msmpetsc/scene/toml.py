"""Text to TOML data, guarded against what takes for ever to parse; and values as TOML has them.

It needs none of the packages that check a scene.
"""

import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from os import PathLike, fspath
from typing import Any

DEEPEST = 50  # parts of a key: tomllib takes time by their square
KEY = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
DEEP_KEY = re.compile(
    rf"(?:^|[\[{{,])[ \t]*{KEY}(?:[ \t]*\.[ \t]*{KEY}){{{DEEPEST}}}", re.MULTILINE
)


def toml_of(text: str) -> dict[str, Any]:
    """Return the text's data. Raises ValueError for what is not TOML, RecursionError for what is nested too deeply."""
    if DEEP_KEY.search(text):
        raise RecursionError
    return tomllib.loads(text)


def plain(value: Any) -> Any:
    """Return a value as TOML has it: arrays and tuples as lists, numpy's numbers as Python's, paths as strings."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, PathLike):
        return fspath(value)
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    return [plain(inner) for inner in value] if isinstance(value, list | tuple) else value


def toml_value(value: Any) -> str:
    """Return a value as it stands in a line of TOML; a key that is None is absent."""
    value = plain(value)
    if isinstance(value, dict):
        return (
            "{"
            + ", ".join(
                f"{key} = {toml_value(inner)}" for key, inner in value.items() if inner is not None
            )
            + "}"
        )
    if isinstance(value, list):
        return f"[{', '.join(map(toml_value, value))}]"
    return json.dumps(value, default=str)


def overrides_of(changes: Mapping[str, Any] | Iterable[str]) -> list[str]:
    """Return changes {"cages.count": 3000} as words of ``--set``, "cages.count=3000"; or the words."""
    if isinstance(changes, Mapping):
        return [f"{key}={toml_value(value)}" for key, value in changes.items()]
    return [changes] if isinstance(changes, str) else list(changes)
