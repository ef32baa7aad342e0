"""Messages for the problems of a scene file: key path, fault, value, suggestion, line."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from msmpetsc.errors import printable
from msmpetsc.scene.suggestions import EXAMPLES, MAX_REPORTED, replacement, suggestion

KeyPath = tuple[str | int, ...]
# a key of a table, and the rule that it breaks
Broken = tuple[str, PydanticCustomError]

# largest scene [lines], [characters] whose line numbers are searched; the search parses
# every prefix of the text
MAX_LINES, MAX_CHARACTERS = 300, 30_000

# message of each pydantic error type; pydantic fills in {gt} and similar fields
WORDS = {
    "missing": "required, but missing",
    "finite_number": "must be a finite number, got {got}",
    "float_type": "must be a number, got {got}",
    "int_type": "must be a whole number, got {got}",
    "string_type": "must be a string, got {got}",
    "string_too_short": "must not be empty",
    "string_too_long": "must have at most {max_length} characters, got {got}",
    "bool_type": "must be true or false, got {got}",
    "tuple_type": "must be a list, got {got}",
    "model_type": "must be a table, got {got}",
    "too_few": "must have {length} items, got {got}",
    "too_short": "must have at least {min_length} item, got {got}",
    "too_long": "must have {max_length} items, got {got}",
    "greater_than": "must be > {gt}, got {got}",
    "greater_than_equal": "must be >= {ge}, got {got}",
    "less_than": "must be < {lt}, got {got}",
    "less_than_equal": "must be <= {le}, got {got}",
    "rule": "{words}, got {got}",
    "one_of": "must give exactly one of {names}; has {given}",
}


def rule(words: str, *others: str) -> PydanticCustomError:
    """Return a broken rule with its message; ``others`` are further keys that it depends on."""
    return PydanticCustomError("rule", "rule", {"words": words, "others": others})


def one_of_problems(data: Any, names: tuple[str, ...], known: list[str]) -> list[InitErrorDetails]:
    """Return a problem unless exactly one of ``names`` is a key of ``data``."""
    if not names or not isinstance(data, dict):
        return []
    given = [name for name in names if name in data]
    # a misspelt key is reported as unknown: a second line would repeat the mistake
    misspelt = not given and any(key not in known for key in data)
    if len(given) == 1 or misspelt:
        return []
    context = {"names": ", ".join(names), "given": " and ".join(given) or "none", "inner": given}
    return [
        InitErrorDetails(type=PydanticCustomError("one_of", "one of", context), loc=(), input=data)
    ]


def problem_lines(
    path: Path, error: ValidationError, text: str, overrides: dict[KeyPath, str]
) -> list[str]:
    """Return a line for each problem: file, key, fault, and the place of the fault.

    The place is an override, or a line of ``text``.
    """
    prefixes = _prefixes(text)
    lines = []
    problems = error.errors(include_url=False)
    for e in problems[:MAX_REPORTED]:
        override = next((o for keys, o in reversed(overrides.items()) if _concerns(e, keys)), None)
        # the first prefix that has the key, or else the innermost table around it
        depths = [_depth(data, e["loc"]) for _, data in prefixes]
        deepest = max(depths, default=0)
        where = ""
        if override:
            where = f" (--set {as_given(override)}{replacement(e, override)})"
        elif deepest:
            where = f" (line {prefixes[depths.index(deepest)][0]})"
        key = ".".join(
            key if re.fullmatch(r"[\w-]+", key) else _got(key) for key in map(str, e["loc"])
        )
        lines.append(": ".join(filter(None, [str(path), key, f"{_words(e)}{where}"])))
    more = len(problems) - MAX_REPORTED
    return [*lines, f"{path}: and {more} more"] if more > 0 else lines


def as_given(value: Any) -> str:
    """Return ``value`` as a shortened line; a string keeps its form without quotes."""
    if isinstance(value, str):
        shown = " ".join(value.split())
    elif isinstance(value, float):
        # the repr of a NumPy 2 scalar includes its type
        shown = repr(float(value))
    else:
        try:
            shown = json.dumps(value, ensure_ascii=False, default=str)
        except (ValueError, RecursionError):
            return "a value too long to show"
    return printable(shown, 60) if len(shown) <= 60 else printable(shown, 57) + "..."


def _got(value: Any) -> str:
    """Return ``value`` as a shortened line, a string in quotes."""
    return (
        as_given(value)
        if not isinstance(value, str)
        else json.dumps(as_given(value), ensure_ascii=False)
    )


def _words(e: ErrorDetails) -> str:
    """Return the message of a problem, without its place."""
    kind = e["type"]
    context = e.get("ctx", {})
    key = e["loc"][-1] if e["loc"] else ""
    if kind in ("model_type", "tuple_type") and key in EXAMPLES:
        return WORDS[kind].format(got=f"{_got(e['input'])}; for example {key} = {EXAMPLES[key]}")
    if kind == "extra_forbidden":
        return f"unknown key, {suggestion(e['loc'][-1], context['valid'])}"
    if kind == "unknown_name":
        return f"unknown value {_got(e['input'])}, {suggestion(e['input'], context['valid'])}"
    if kind == "literal_error":
        valid = re.findall(r"'([^']*)'", context["expected"])
        return f"unknown value {_got(e['input'])}, {suggestion(e['input'], valid)}"
    figures = {name: f"{x:g}" if isinstance(x, float) else x for name, x in context.items()}
    return WORDS.get(kind, "is not valid, got {got}").format(got=_got(e["input"]), **figures)


def _concerns(e: ErrorDetails, keys: KeyPath) -> bool:
    """Return whether an override of ``keys`` set the key at fault, a part of it, or its table."""
    loc = e["loc"]
    context = e.get("ctx", {})
    if e["type"] == "one_of":
        suspects = [(*loc, name) for name in context["inner"]]
    else:
        suspects = [loc, *((*loc[:-1], name) for name in context.get("others", ()))]
    return any(all(a == b for a, b in zip(suspect, keys, strict=False)) for suspect in suspects)


def _prefixes(text: str) -> list[tuple[int, dict[str, Any]]]:
    """Return the first line of each TOML statement, with the data of the text up to its end.

    A statement ends at the first line up to which the text parses.
    """
    lines = text.split("\n")
    if len(lines) > MAX_LINES or len(text) > MAX_CHARACTERS:
        return []
    statements = []
    start = 1
    for end in range(1, len(lines) + 1):
        try:
            data = tomllib.loads("\n".join(lines[:end]) + "\n")
        except tomllib.TOMLDecodeError:
            continue
        statements.append((start, data))
        start = end + 1
    return statements


def _depth(data: Any, loc: KeyPath) -> int:
    """Return the number of leading keys of ``loc`` that exist in ``data``."""
    for depth, key in enumerate(loc):
        inside = (isinstance(data, dict) and key in data) or (
            isinstance(data, list) and key in range(len(data))
        )
        if not inside:
            return depth
        data = data[key]
    return len(loc)
