"""Messages for the problems of a scene file: key path, fault, value, nearest valid name, line."""

import json
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from msmpetsc.errors import nearest, printable

KeyPath = tuple[str | int, ...]
# a key of a table, and the rule that it breaks
Broken = tuple[str, PydanticCustomError]

# largest scene [lines], [characters] whose line numbers are searched; the search parses
# every prefix of the text
MAX_LINES, MAX_CHARACTERS = 300, 30_000
# tags of a union of a vector and a table; pydantic adds them to the path of a key
TAGS = ("a vector", "a table")
# largest number of problems in a message [-]; more would fill the screen
MAX_REPORTED = 100

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
# examples of tables, lists of tables and vectors, shown if a value has another type
EXAMPLES = {
    "mesh": '{ source = "body.ply" }',
    "cages": "{ count = 3000 }",
    "material": "{ young_modulus = 1e5, density = 1000 }",
    "time": "{ step = 0.01, duration = 1.0 }",
    "gravity": "{ acceleration = [0, 0, -9.81] }",
    "acceleration": "[0, 0, -9.81]",
    "start": "{ velocity = [0, 0, -1] }",
    "velocity": "[0, 0, -1]",
    "spin": "[0, 0, 1]",
    "scale": "[1, 1, 1.2]",
    "twist": "{ axis = [0, 0, 1], degrees = 90 }",
    "self_contact": "{ friction = 0.3 }",
    "solver": "{ error = 1e-3 }",
    "safety": '{ on_failure = "substep" }',
    "output": "{ every = 2 }",
    "picture": "{ times = [0.1] }",
    "body": '[{ mesh = { source = "body.ply" } }]',
    "region": "{ box = [[0, 0, 0.9], [1, 1, 1]], relative = true }",
    "pin": "[{ region = { box = [[0, 0, 0], [1, 1, 0.1]], relative = true } }]",
    "part": "[{ region = { box = [[0, 0, 0], [1, 1, 0.1]], relative = true }, "
    "young_modulus = 1e6 }]",
    "anchor": "[{ region = { box = [[0, 0, 0.9], [1, 1, 1]] }, "
    "path = [{ time = 1.0, by = [0, 0, 0.1] }] }]",
    "path": "[{ time = 1.0, by = [0, 0, 0.1] }]",
    "force": "[{ region = { box = [[0, 0, 0.9], [1, 1, 1]] }, total = [0, 0, -1] }]",
    "total": "[0, 0, -1]",
    "obstacle": '[{ shape = "plane", point = [0, 0, 0], normal = [0, 0, 1] }]',
    "probe": '[{ name = "tip", point = [0, 0, 0.1] }]',
}


def rule(words: str, *others: str) -> PydanticCustomError:
    """Return a broken rule with its message; ``others`` are further keys that it depends on."""
    return PydanticCustomError("rule", "rule", {"words": words, "others": others})


def unknown_name(valid: Iterable[str]) -> PydanticCustomError:
    """Return the problem of a name that is not in ``valid``."""
    return PydanticCustomError("unknown_name", "unknown name", {"valid": list(valid)})


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


def restated(error: ValidationError, known: list[str]) -> list[InitErrorDetails]:
    """Return pydantic's problems of a table in a form that can be raised again.

    An unknown key gets the table's keys for a suggestion. A missing key that is probably a
    misspelt unknown key is dropped. The missing items of a short list become a single problem.

    known : keys of the table
    """
    errors = error.errors(include_url=False)
    unknown = [e["loc"][0] for e in errors if e["type"] == "extra_forbidden" and len(e["loc"]) == 1]
    meant = {_nearest(key, known) for key in unknown[:MAX_REPORTED]}
    problems: dict[Any, InitErrorDetails] = {}
    for number, e in enumerate(errors):
        kind = e["type"]
        context = dict(e.get("ctx", {}))
        loc = tuple(key for key in e["loc"] if key not in TAGS)
        identity: Any = number
        if kind == "extra_forbidden" and len(loc) == 1:
            context["valid"] = known
        elif kind == "missing" and isinstance(loc[-1], int):
            kind = "too_few"
            context = {"length": loc[-1] + 1}
            identity = loc = loc[:-1]
        elif kind == "missing" and len(loc) == 1 and loc[0] in meant:
            continue
        custom = PydanticCustomError(kind, "{kind}", context)
        problems[identity] = InitErrorDetails(type=custom, loc=loc, input=e["input"])
    return list(problems.values())


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
            where = f" (--set {as_given(override)}{_replacement(e, override)})"
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
        return f"unknown key, {_suggestion(e['loc'][-1], context['valid'])}"
    if kind == "unknown_name":
        return f"unknown value {_got(e['input'])}, {_suggestion(e['input'], context['valid'])}"
    if kind == "literal_error":
        valid = re.findall(r"'([^']*)'", context["expected"])
        return f"unknown value {_got(e['input'])}, {_suggestion(e['input'], valid)}"
    figures = {name: f"{x:g}" if isinstance(x, float) else x for name, x in context.items()}
    return WORDS.get(kind, "is not valid, got {got}").format(got=_got(e["input"]), **figures)


def _replacement(e: ErrorDetails, override: str) -> str:
    """Return an override of the whole table, the only way to remove the key that excludes it."""
    *table, key = override.partition("=")[0].split(".")
    if e["type"] != "one_of" or tuple(table) != e["loc"] or not table:
        return ""
    value = override.partition("=")[2]
    return f"; in place of all keys there: --set '{'.'.join(table)}={{{key}={value}}}'"


def _nearest(word: Any, valid: list[str]) -> str | None:
    """Return the valid name most similar to a word of any case; None if no name is similar."""
    return nearest(str(word).lower()[:100], valid)


def _suggestion(word: Any, valid: list[str]) -> str:
    """Return the most similar valid name as a question, or else all valid names."""
    near = _nearest(word, valid)
    return f"did you mean {near!r}?" if near else f"valid: {', '.join(valid)}"


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
