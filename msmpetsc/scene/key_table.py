"""The keys of a scene as a table, out of its schema: unit, default, range and meaning of each."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.scene.schema import SceneFile

SCHEMA_FILE = "msmpetsc.schema.json"  # which a scene's first line names, for editors
DIALECT = "https://json-schema.org/draft/2020-12/schema"
IF_ABSENT = re.compile(r"[;,] ([^;,]+) if absent")
BOUNDS = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
UNREACHED = 1e18  # a bound beyond it only keeps numbers within a double or a 64-bit integer
BRACES = re.compile(r"\{.*?\}")  # of an example: units within are not the key's own
UNIT, LAST_UNIT = re.compile(r"\[([^]]+)\]"), re.compile(r"\s*\[[^]]+\]$")
NUMBERED = re.compile(r"\.(\d+|N)(?=\.|$)")  # the number of a [[table]]


@dataclass(frozen=True)
class SceneKey:
    """A key of a scene file, in words.

    name : as ``--set`` takes it, N for the number of a [[table]]: "pin.N.region.box"
    """

    name: str
    unit: str
    default: str
    bounds: str
    about: str


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of a scene file. TOML has no null: a key that may be absent is of its kind alone."""
    return {"$schema": DIALECT, **_without_null(SceneFile.model_json_schema())}


def keys(prefix: str = "") -> list[SceneKey]:
    """Return all keys, or those of a table or the one of this name. Raises InputError where there is none."""
    schema = _without_null(SceneFile.model_json_schema())
    every = list(_keys(schema, schema, ""))
    wanted = NUMBERED.sub("", prefix)
    chosen = [key for key in every if f"{NUMBERED.sub('', key.name)}.".startswith(f"{wanted}." if wanted else "")]
    if not chosen:
        names = [NUMBERED.sub("", key.name) for key in every]
        tables = {name.rpartition(".")[0] for name in names} - {""}
        raise InputError(f"a scene has no key {prefix!r}{did_you_mean(wanted, [*tables, *names])}")
    return chosen


def _keys(schema: dict[str, Any], table: dict[str, Any], prefix: str) -> Iterator[SceneKey]:
    one_of = [name for choice in table.get("oneOf", ()) for name in choice["required"]]
    for name, found in table["properties"].items():
        inner = found.get("items", found).get("$ref", "").rpartition("/")[2]
        if inner:
            yield from _keys(schema, schema["$defs"][inner], f"{prefix}{name}{'.N' * ('items' in found)}.")
            continue
        text = found.get("description", "")
        if name in one_of:
            default = f"one of {', '.join(one_of)}"
        else:
            default = "required" if name in table.get("required", ()) else _default(found, text)
        units = " or ".join(dict.fromkeys(UNIT.findall(BRACES.sub("", text))))
        about = LAST_UNIT.sub("", IF_ABSENT.sub("", LAST_UNIT.sub("", IF_ABSENT.sub("", text)))).strip()
        yield SceneKey(prefix + name, units, default, _bounds(found), about)


def _default(found: dict[str, Any], text: str) -> str:
    absent = IF_ABSENT.search(text)
    if absent:
        return absent[1]
    value = found.get("default")
    return "none" if value in (None, [], "") else str(value).lower() if isinstance(value, bool) else f"{value}"


def _bounds(found: dict[str, Any]) -> str:
    if "enum" in found:
        return " | ".join(map(str, found["enum"]))
    bounds = [f"{sign} {found[word]:g}" for word, sign in BOUNDS.items() if abs(found.get(word, UNREACHED)) < UNREACHED]
    kind = {"boolean": "true | false", "integer": "whole", "array": "list", "string": "text"}.get(found.get("type", ""))
    return " ".join(filter(None, [kind, ", ".join(bounds)]))


def _without_null(node: Any) -> Any:
    """Return a schema in which nothing is, or defaults to, null."""
    if isinstance(node, list):
        return [_without_null(inner) for inner in node]
    if not isinstance(node, dict):
        return node
    choices = [choice for choice in node.get("anyOf", ()) if choice != {"type": "null"}]
    kept = {name: inner for name, inner in node.items() if name != "anyOf" and inner is not None}
    if len(choices) == 1:
        kept = choices[0] | kept
    elif choices:
        kept["anyOf"] = choices
    return {name: _without_null(inner) for name, inner in kept.items()}
