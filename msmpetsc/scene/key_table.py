"""The keys of a scene as a table, out of its schema: default, range, meaning and unit of each."""

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core.core_schema import NullableSchema, WithDefaultSchema

from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.scene.schema import SceneFile
from msmpetsc.scene.toml import toml_value

SCHEMA_FILE = "msmpetsc.schema.json"  # which a scene's first line names, for editors
DIALECT = "https://json-schema.org/draft/2020-12/schema"
BOUNDS = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
UNREACHED = 1e18  # a bound beyond it only keeps numbers within a double or a 64-bit integer
NUMBERED = re.compile(r"\.(\d+|N)(?=\.|$)")  # the number of a [[table]]


class SceneKey(NamedTuple):
    """A key of a scene file, in words.

    name : as ``--set`` takes it, N for the number of a [[table]]: "pin.N.region.box"
    """

    name: str
    default: str
    bounds: str
    about: str


class WithoutNull(GenerateJsonSchema):
    """A JSON schema without null, which TOML lacks: a key that may be absent has its kind."""

    def nullable_schema(self, schema: NullableSchema) -> JsonSchemaValue:
        """Return the schema of the kind alone."""
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: WithDefaultSchema) -> JsonSchemaValue:
        """Return the schema without a default that is null."""
        return {
            name: value
            for name, value in super().default_schema(schema).items()
            if value is not None
        }


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of a scene file."""
    return {"$schema": DIALECT, **SceneFile.model_json_schema(schema_generator=WithoutNull)}


def keys(prefix: str = "") -> list[SceneKey]:
    """Return all keys, or those of a table or of this name. Raises InputError where there is none."""
    schema = json_schema()
    every = list(_keys(schema, schema, ""))
    wanted = NUMBERED.sub("", prefix)
    chosen = [
        key
        for key in every
        if f"{NUMBERED.sub('', key.name)}.".startswith(f"{wanted}." if wanted else "")
    ]
    if not chosen:
        names = [NUMBERED.sub("", key.name) for key in every]
        tables = {name.rpartition(".")[0] for name in names} - {""}
        raise InputError(f"a scene has no key {prefix!r}{did_you_mean(wanted, [*tables, *names])}")
    return chosen


def _keys(schema: dict[str, Any], table: dict[str, Any], prefix: str) -> Iterator[SceneKey]:
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
        if abs(field.get(word, UNREACHED)) < UNREACHED
    ]
    kind = {"boolean": "true | false", "integer": "whole", "array": "list", "string": "text"}.get(
        field.get("type", "")
    )
    return " ".join(filter(None, [kind, ", ".join(bounds)]))
