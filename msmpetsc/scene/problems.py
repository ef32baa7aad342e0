"""Messages for the problems of a scene file: key path, fault, value, nearest key."""

import json
import re
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails, PydanticCustomError

from msmpetsc.errors import did_you_mean, printable

KeyPath = tuple[str | int, ...]
# a key of a table, and the rule that it breaks
Broken = tuple[str, PydanticCustomError]

# tags of a union of a vector and a table; pydantic adds them to the path of a key
TAGS = ("a vector", "a table")
# messages that replace pydantic's, in the terms of TOML
WORDS = {
    "missing": "required, but missing",
    "model_type": "must be a table",
    "tuple_type": "must be a list",
}


def rule(words: str) -> PydanticCustomError:
    """Return the error of a broken rule, with its message."""
    return PydanticCustomError("rule", "{words}", {"words": words})


def unknown_key(key: Any, valid: list[str]) -> PydanticCustomError:
    """Return the error of a key that is not in ``valid``."""
    near = did_you_mean(str(key).lower()[:100], valid) or f", valid: {', '.join(valid)}"
    return PydanticCustomError("unknown_key", "{words}", {"words": f"unknown key{near}"})


def problem_lines(path: Path, error: ValidationError) -> list[str]:
    """Return a line for each problem: file, key, fault and value."""
    lines = []
    for e in error.errors(include_url=False):
        key = ".".join(as_given(str(key)) for key in e["loc"] if key not in TAGS)
        lines.append(": ".join(filter(None, [str(path), key, _words(e)])))
    return lines


def _words(e: ErrorDetails) -> str:
    """Return the message of a problem, without its place."""
    words = WORDS.get(e["type"]) or re.sub(r"^\w+ should", "must", e["msg"])
    value = e["input"]
    tables = value if isinstance(value, tuple) else (value,)
    # a table that was read is no longer TOML, so it is not shown
    is_read = any(isinstance(table, BaseModel) for table in tables)
    if e["type"] in ("missing", "unknown_key") or is_read:
        return words
    got = as_given(value)
    return f"{words}, got {json.dumps(got, ensure_ascii=False) if isinstance(value, str) else got}"


def as_given(value: Any) -> str:
    """Return ``value`` as a line of at most 60 characters; a string has no quotes."""
    if isinstance(value, str):
        shown = " ".join(value.split())
    elif isinstance(value, float):
        # the repr of a NumPy 2 scalar includes its type
        shown = repr(float(value))
    else:
        try:
            shown = json.dumps(value, ensure_ascii=False, default=str)
        # Python converts no integer of over 4,300 digits and no table of many levels
        except (ValueError, RecursionError):
            return "a value too long to show"
    return printable(shown, 60) if len(shown) <= 60 else printable(shown, 57) + "..."
