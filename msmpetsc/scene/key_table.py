"""The table of a scene's keys, made from the schema: default, range, meaning and unit."""

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core.core_schema import NullableSchema, WithDefaultSchema

from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.scene.schema import SceneFile
from msmpetsc.scene.toml import toml_value

# name of the schema file; the first line of a scene names it for editors
SCHEMA_FILE = "msmpetsc.schema.json"
DIALECT = "https://json-schema.org/draft/2020-12/schema"
BOUNDS = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
# bounds from this size on are not shown [-]; they only keep numbers within their type
HIDDEN_BOUND = 1e18
# the number of a [[table]] in a key
NUMBERED = re.compile(r"\.(\d+|N)(?=\.|$)")


class SceneKey(NamedTuple):
    """The documentation of a key of a scene file.

    name : as in ``--set``, with N for the number of a [[table]], for example "pin.N.region.box"
    """

    name: str
    default: str
    bounds: str
    about: str


class WithoutNull(GenerateJsonSchema):
    """Generator of a JSON schema without null, which TOML lacks."""

    def nullable_schema(self, schema: NullableSchema) -> JsonSchemaValue:
        """Return the schema of an optional value without the null alternative."""
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: WithDefaultSchema) -> JsonSchemaValue:
        """Return the schema of a value without a null default."""
        return {
            name: value
            for name, value in super().default_schema(schema).items()
            if value is not None
        }


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of a scene file."""
    return {"$schema": DIALECT, **SceneFile.model_json_schema(schema_generator=WithoutNull)}


def keys(prefix: str = "") -> list[SceneKey]:
    """Return the key of a name, the keys of a table, or all keys.

    Raises InputError for an unknown name.
    """
    schema = json_schema()
    all_keys = list(_keys(schema, schema, ""))
    name = NUMBERED.sub("", prefix)
    chosen = [
        key
        for key in all_keys
        if f"{NUMBERED.sub('', key.name)}.".startswith(f"{name}." if name else "")
    ]
    if not chosen:
        names = [NUMBERED.sub("", key.name) for key in all_keys]
        tables = {name.rpartition(".")[0] for name in names} - {""}
        raise InputError(f"a scene has no key {prefix!r}{did_you_mean(name, [*tables, *names])}")
    return chosen


def _keys(schema: dict[str, Any], table: dict[str, Any], prefix: str) -> Iterator[SceneKey]:
    """Yield the keys of a table of the JSON schema and of the tables inside it."""
    one_of = [name for choice in table.get("oneOf", ()) for name in choice["required"]]
    for name, field in table["properties"].items():
        inner = field.get("items", field).get("$ref", "").rpartition("/")[2]
        if inner:
            yield from _keys(
                schema, schema["$defs"][inner], f"{prefix}{name}{'.N' * ('items' in field)}."
            )
            continue
        if name in one_of:
            default = f"one of {', '.join(one_of)}"
        elif name in table.get("required", ()):
            default = "required"
        else:
            default = (
                "none" if field.get("default") in (None, "", []) else toml_value(field["default"])
            )
        yield SceneKey(prefix + name, default, _bounds(field), field.get("description", ""))


def _bounds(field: dict[str, Any]) -> str:
    if "enum" in field:
        return " | ".join(map(str, field["enum"]))
    bounds = [
        f"{sign} {field[word]:g}"
        for word, sign in BOUNDS.items()
        if abs(field.get(word, HIDDEN_BOUND)) < HIDDEN_BOUND
    ]
    kind = {"boolean": "true | false", "integer": "whole", "array": "list", "string": "text"}.get(
        field.get("type", "")
    )
    return " ".join(filter(None, [kind, ", ".join(bounds)]))
