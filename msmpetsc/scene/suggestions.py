"""Suggestions for the problems of a scene file: nearest keys and names, examples, overrides."""

from collections.abc import Iterable
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from msmpetsc.errors import nearest

# tags of a union of a vector and a table; pydantic adds them to the path of a key
TAGS = ("a vector", "a table")
# largest number of problems in a message [-]; more would fill the screen
MAX_REPORTED = 100
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
    "gradient": "[[0, 0, 0], [0, 0, 0], [0, 0, 1]]",
    "scale": "[1, 1, 1.2]",
    "twist": "{ axis = [0, 0, 1], degrees = 90 }",
    "swirl": "{ axis = [0, 0, 1], distances = [0, 1], rates = [0, 10] }",
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
    "traction": "[{ region = { box = [[0, 0, 0.9], [1, 1, 1]] }, value = [0, 0, -1] }]",
    "pressure": "[{ region = { box = [[0, 0, 0], [1, 1, 1]], relative = true }, value = 1 }]",
    "total": "[0, 0, -1]",
    "obstacle": '[{ shape = "plane", point = [0, 0, 0], normal = [0, 0, 1] }]',
    "probe": '[{ name = "tip", point = [0, 0, 0.1] }]',
}


def unknown_name(valid: Iterable[str]) -> PydanticCustomError:
    """Return the problem of a name that is not in ``valid``."""
    return PydanticCustomError("unknown_name", "unknown name", {"valid": list(valid)})


def restated(error: ValidationError, known: list[str]) -> list[InitErrorDetails]:
    """Return pydantic's problems of a table in a form that can be raised again.

    An unknown key gets the table's keys for a suggestion. A missing key that is probably a
    misspelt unknown key is dropped. The missing items of a short list become a single problem.

    known : keys of the table
    """
    errors = error.errors(include_url=False)
    unknown = [e["loc"][0] for e in errors if e["type"] == "extra_forbidden" and len(e["loc"]) == 1]
    meant = {nearest_name(key, known) for key in unknown[:MAX_REPORTED]}
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


def replacement(e: ErrorDetails, override: str) -> str:
    """Return an override of the whole table, the only way to remove the key that excludes it."""
    *table, key = override.partition("=")[0].split(".")
    if e["type"] != "one_of" or tuple(table) != e["loc"] or not table:
        return ""
    value = override.partition("=")[2]
    return f"; in place of all keys there: --set '{'.'.join(table)}={{{key}={value}}}'"


def nearest_name(word: Any, valid: list[str]) -> str | None:
    """Return the valid name most similar to a word of any case; None if no name is similar."""
    return nearest(str(word).lower()[:100], valid)


def suggestion(word: Any, valid: list[str]) -> str:
    """Return the most similar valid name as a question, or else all valid names."""
    near = nearest_name(word, valid)
    return f"did you mean {near!r}?" if near else f"valid: {', '.join(valid)}"
