"""The table of simulated time, and the rules of a scene that depend on its integrator.

In statics, where nothing moves, much has no meaning; exchange and a surface that meets itself want implicit steps.
"""

from collections.abc import Iterator
from typing import Any, Final

from pydantic import ConfigDict, Field, ValidationInfo, field_validator

from msmpetsc.scene.problems import Broken, rule
from msmpetsc.scene.values import IntegratorName, Positive, Table, only_for

MOST_STEPS = 10**9
STATIC: Final = "static"  # time.integrator
IMPLICIT = ("implicit-euler", "bdf2")
OF_TIME = ("path", "times", "start", "stop")  # keys of what comes, goes or moves


def _wanted_in_motion(schema: dict[str, Any]) -> None:
    """Say in the JSON schema that only statics need no step and duration (``one_state``)."""
    is_static = {"properties": {"integrator": {"const": STATIC}}, "required": ["integrator"]}
    schema.update({"if": is_static, "else": {"required": schema.pop("required")}})


class Time(Table):
    """Simulated time."""

    model_config = ConfigDict(json_schema_extra=_wanted_in_motion)
    step: Positive = Field(
        description="time step; required but of statics that stay the same if absent [s]"
    )
    duration: Positive = Field(
        description="simulated time; required but of statics that stay the same if absent [s]"
    )
    integrator: IntegratorName = Field(
        "implicit-euler",
        description="how a step is taken: solved at once, of first or second order; in explicit substeps; or as a "
        "state of equilibrium",
    )
    substep: Positive | None = Field(
        None,
        description='longest substep of integrator = "verlet"; under the stability limit if absent [s]',
    )
    error: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="of the motion, relative: steps are as long as it allows, all alike if absent [-]",
    )

    _has_a_use = field_validator("substep")(only_for("integrator", "verlet"))
    _chooses = field_validator("error")(only_for("integrator", *IMPLICIT))

    @field_validator("duration")
    @classmethod
    def _holds_a_step(cls, duration: float, info: ValidationInfo) -> float:
        step = info.data.get("step", duration)
        if duration / step > MOST_STEPS:
            raise rule(f"holds too many steps of {step:g} s", "step")
        if round(duration / step) < 1:
            raise rule(f"must hold at least one step of {step:g} s", "step")
        return duration

    @property
    def steps(self) -> int:
        """Return the number of time steps."""
        return round(self.duration / self.step)


def one_state(data: Any) -> Any:
    """Return a scene's data, unchecked, with its one state where nothing changes in time: it wants no step or duration.

    Of step and duration, either says how long the other is.
    """
    time = data.get("time") if isinstance(data, dict) else None
    if not isinstance(time, dict) or time.get("integrator") != STATIC:
        return data
    for load in _loads(data):
        if (
            isinstance(load.get("total"), dict)
            or "function" in load
            or any(name in load for name in OF_TIME)
        ):
            return data
    one = time.get("step", time.get("duration", 1.0))
    return {**data, "time": {"step": one, "duration": one, **time}}


def _loads(tables: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield what moves or presses the bodies of a scene, unchecked."""
    for name in ("anchor", "force", "obstacle", "body"):
        given = tables.get(name)
        for table in given if isinstance(given, list | tuple) else ():
            if isinstance(table, dict):
                yield from _loads(table) if name == "body" else [table]


def unlike_the_integrator(scene: Any) -> Iterator[Broken]:
    """Yield the rules that tables of a scene break by its integrator."""
    integrator = scene.time.integrator
    if scene.material.retardation_time and integrator not in IMPLICIT:
        words = (
            f'may not have integrator = "{integrator}" where material.retardation_time is given: '
        )
        yield "time", rule(f'{words}"implicit-euler" and "bdf2" have', "material")
    if integrator == STATIC:
        yield from _moving(scene)
    if scene.touching and integrator not in IMPLICIT:
        words = f'is for time.integrator = "implicit-euler" or "bdf2" only, not "{integrator}"'
        barrier = "" if scene.self_contact else 'with response = "barrier" '
        yield "self_contact" if scene.self_contact else "obstacle", rule(barrier + words, "time")
    for number, obstacle in enumerate(scene.obstacle):
        if obstacle.response != "exchange":
            continue
        if integrator == "bdf2":  # a step would see that nodes were set back
            words = f'may not be "bdf2" with response = "exchange", as obstacle.{number} has it: it sets nodes back by '
            yield "obstacle", rule(f'{words}one step; "reflect" and "penalty" go', "time")
        if scene.touching:
            words = f'may not have response = "exchange" where surfaces meet, as obstacle.{number} has it: that moves '
            yield (
                "obstacle",
                rule(
                    f'{words}nodes past each other; "reflect" and "penalty" press', "self_contact"
                ),
            )


def _moving(scene: Any) -> Iterator[Broken]:
    """Yield the rules that a scene of statics breaks by what moves, depends on motion or rubs."""
    if scene.material.damping:
        words = (
            f'may not have integrator = "{STATIC}" where material.damping is given: nothing moves'
        )
        yield "time", rule(words, "material")
    bodies = [("body", f"body.{number}.", body) for number, body in enumerate(scene.body)]
    for key, whose, tables in [("", "", scene), *bodies]:
        if tables.start is not None and (any(tables.start.velocity) or any(tables.start.spin)):
            words = f'{key and f"{whose}start "}may have no velocity or spin where time.integrator = "{STATIC}": '
            yield key or "start", rule(f"{words}there is no inertia", "time")
        for number, force in enumerate(tables.force):
            if force.function is not None:
                words = f'may be no function where time.integrator = "{STATIC}", as {whose}force.{number} is: it is '
                yield (
                    key or "force",
                    rule(f"{words}that of the state before, which is not at rest under it", "time"),
                )
    for number, obstacle in enumerate(scene.obstacle):
        if obstacle.response not in ("penalty", "barrier"):
            words = f'may not {obstacle.response} where time.integrator = "{STATIC}", as obstacle.{number} does: '
            yield (
                "obstacle",
                rule(f'{words}nothing strikes it; response = "penalty" presses', "time"),
            )
        if obstacle.friction:
            words = f'may have no friction where time.integrator = "{STATIC}", as obstacle.{number} has: it depends on '
            yield (
                "obstacle",
                rule(f"{words}the way there, which steps in motion with damping take", "time"),
            )
