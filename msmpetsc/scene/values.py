"""Types of the values in a scene, and the base class of its tables."""

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import InitErrorDetails

from msmpetsc.scene.problems import Broken, rule, unknown_key


def _unit(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(vector):
        raise rule("must not be the zero vector")
    # divide by the largest component first, so that no square overflows or underflows
    longest = max(map(abs, vector))
    x, y, z = (c / longest for c in vector)
    length = math.hypot(x, y, z)
    return x / length, y / length, z / length


def _some(components: tuple[str, ...]) -> tuple[str, ...]:
    if not components:
        raise rule("must name one to three components")
    return components


# below 1e60, so that the fourth power is finite
Positive = Annotated[float, Field(gt=0, lt=1e60)]
NotNegative = Annotated[float, Field(ge=0, lt=1e60)]
# TOML's integers have 64 bits
Count = Annotated[int, Field(gt=0, lt=2**63)]
T = TypeVar("T")
# not strict, because TOML has lists but no tuples
ListOf = Annotated[tuple[T, ...], Strict(False)]
Vector = Annotated[tuple[float, float, float], Strict(False)]
Components = Annotated[tuple[Literal["x", "y", "z"], ...], Strict(False), AfterValidator(_some)]
UnitVector = Annotated[Vector, AfterValidator(_unit)]


def _has_a_volume(box: tuple[Vector, Vector]) -> tuple[Vector, Vector]:
    if not all(low < high for low, high in zip(*box, strict=True)):
        raise rule("must have each coordinate of the first corner below that of the second")
    return box


def _printable(name: str) -> str:
    if not name.isprintable():
        raise rule("must be of printable characters")
    return name


def _painted(value: Any) -> str | tuple[int, ...]:
    """Return the name of a file of point numbers, or the numbers; raise a broken rule."""
    if isinstance(value, str) and 0 < len(value) <= 1000:
        return _printable(value)
    numbers = isinstance(value, list | tuple) and all(
        type(n) is int and 0 <= n < 2**63 for n in value
    )
    if not numbers or not value:
        raise rule("must be a list of point numbers, from 0, or the name of a file that has them")
    return tuple(value)


def after_start(cls: Any, stop: float | None, info: ValidationInfo) -> float | None:
    """Return ``stop`` as a pydantic validator; raise a broken rule unless stop > start."""
    start = info.data.get("start")
    if stop is not None and start is not None and stop <= start:
        raise rule(f"must be > start = {start:g}")
    return stop


def refuse_unlike(places: Sequence[float], values: Sequence[Any], name: str, of: str) -> None:
    """Raise a broken rule unless the places of a piecewise linear function ascend.

    Each place must have a value.

    name, of : the keys of the places and of the values
    """
    if any(a >= b for a, b in pairwise(places)):
        raise rule(f"must have ascending {name}")
    if not places or len(places) != len(values):
        raise rule(
            f"has {len(places)} {name} and {len(values)} {of}: as many are needed, at least one"
        )


def only_for(key: str, *values: str) -> Callable[..., Any]:
    """Return a validator of a key that is allowed only if another key has a given value."""

    def check(cls: Any, given: Any, info: ValidationInfo) -> Any:
        if info.data.get(key, values[0]) not in values:
            raise rule(f"is for {key} = {' or '.join(map(json.dumps, values))} only")
        return given

    return check


def _known_preset(name: str, info: ValidationInfo) -> str:
    presets = (info.context or {}).get("presets")
    if presets is not None and name not in presets:
        raise rule(f"must be one of {', '.join(presets)}")
    return name


def _as_name(value: Any) -> Any:
    """Return a number as text, as the name of a group; return any other value unchanged."""
    return str(value) if type(value) is int else value


FileName = Annotated[str, Field(min_length=1, max_length=1000), AfterValidator(_printable)]
GroupName = Annotated[FileName, BeforeValidator(_as_name)]
FunctionName = Annotated[str, Field(min_length=1, max_length=100), AfterValidator(_printable)]
IntegratorName = Literal["implicit-euler", "bdf2", "verlet", "static"]
PresetName = Annotated[str, AfterValidator(_known_preset)]
Matrix = Annotated[tuple[Vector, Vector, Vector], Strict(False)]
Box = Annotated[tuple[Vector, Vector], Strict(False), AfterValidator(_has_a_volume)]
Painted = Annotated[str | tuple[int, ...], BeforeValidator(_painted)]


def _one_of_in_schema(schema: dict[str, Any], table: type["Table"]) -> None:
    """Add the alternative keys of a table (``one_of``) to its JSON schema."""
    if table.one_of:
        schema["oneOf"] = [{"required": [name]} for name in table.one_of]


class Table(BaseModel):
    """Base class of the tables of a scene file.

    one_of : alternative keys; a table must give exactly one
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        strict=True,
        allow_inf_nan=False,
        json_schema_extra=_one_of_in_schema,
    )
    one_of: ClassVar[tuple[str, ...]] = ()

    def broken_rules(self) -> Iterator[Broken]:
        """Yield the broken rules between keys whose own values are valid."""
        return iter(())

    @model_validator(mode="before")
    @classmethod
    def _has_known_keys(cls, data: Any) -> Any:
        known = [field.alias or name for name, field in cls.model_fields.items()]
        if isinstance(data, dict):
            _raise_all(data, [(key, unknown_key(key, known)) for key in data if key not in known])
        return data

    @model_validator(mode="after")
    def _keeps_rules(self) -> Self:
        given = [name for name in self.one_of if name in self.model_fields_set]
        if self.one_of and len(given) != 1:
            has = " and ".join(given) or "none"
            raise rule(f"must give exactly one of {', '.join(self.one_of)}; has {has}")
        _raise_all(vars(self), self.broken_rules())
        return self


def _raise_all(data: Mapping[str, Any], broken: Iterable[Broken]) -> None:
    """Raise all broken rules of a table together, if there are any."""
    problems = [
        InitErrorDetails(type=problem, loc=(key,), input=data[key]) for key, problem in broken
    ]
    if problems:
        raise ValidationError.from_exception_data("table", problems)
