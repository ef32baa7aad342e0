"""Conversion of data to TOML text; imports only Python's standard library."""

import json
from collections.abc import Iterable, Mapping
from os import PathLike, fspath
from typing import Any


def plain(value: Any) -> Any:
    """Return a value in TOML's types: arrays as lists, numpy scalars as numbers, paths as text."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, PathLike):
        return fspath(value)
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    return [plain(inner) for inner in value] if isinstance(value, list | tuple) else value


def toml_value(value: Any) -> str:
    """Return a value as a line of TOML; keys whose value is None are left out."""
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
    """Return changes as values of ``--set``: {"cages.count": 3000} as ["cages.count=3000"]."""
    if isinstance(changes, Mapping):
        return [f"{key}={toml_value(value)}" for key, value in changes.items()]
    return [changes] if isinstance(changes, str) else list(changes)
