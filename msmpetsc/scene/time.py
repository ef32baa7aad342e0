"""The table ``time`` of a scene, and the rules between the integrator and other tables."""

from collections.abc import Iterator
from typing import Any, Final

from pydantic import ConfigDict, Field, ValidationInfo, field_validator

from msmpetsc.scene.problems import Broken, rule
from msmpetsc.scene.values import IntegratorName, Positive, Table, only_for

# largest number of steps [-]; far above any run
MAX_STEPS = 10**9
STATIC: Final = "static"
IMPLICIT = ("implicit-euler", "bdf2")
# tables that act on bodies, and keys of these tables that vary over time
LOADS = ("anchor", "force", "traction", "pressure", "obstacle", "body")
TIME_KEYS = ("path", "times", "start", "stop")


def _require_times(schema: dict[str, Any]) -> None:
    """Require step and duration in the JSON schema, except for statics (``one_state``)."""
    is_static = {"properties": {"integrator": {"const": STATIC}}, "required": ["integrator"]}
    schema.update({"if": is_static, "else": {"required": schema.pop("required")}})


class Time(Table):
    """Simulated time and its integrator."""

    model_config = ConfigDict(json_schema_extra=_require_times)
    step: Positive = Field(
        description="time step; optional only for statics with constant loads [s]"
    )
    duration: Positive = Field(
        description="simulated time; optional only for statics with constant loads [s]"
    )
    integrator: IntegratorName = Field(
        "implicit-euler",
        description="time integrator: implicit-euler (first order), bdf2 (second order), verlet "
        "(explicit substeps), or static (an equilibrium in each step)",
    )
    substep: Positive | None = Field(
        None,
        description='longest substep, with integrator = "verlet"; from the stability limit if '
        "absent [s]",
    )
    error: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="target relative error of the motion, which chooses the step lengths; equal "
        "steps if absent [-]",
    )

    _has_a_use = field_validator("substep")(only_for("integrator", "verlet"))
    _chooses = field_validator("error")(only_for("integrator", *IMPLICIT))

    @field_validator("duration")
    @classmethod
    def _holds_a_step(cls, duration: float, info: ValidationInfo) -> float:
        step = info.data.get("step", duration)
        if duration / step > MAX_STEPS:
            raise rule(f"holds too many steps of {step:g} s")
        if round(duration / step) < 1:
            raise rule(f"must hold at least one step of {step:g} s")
        return duration

    @property
    def steps(self) -> int:
        """Return the number of time steps."""
        return round(self.duration / self.step)


def one_state(data: Any) -> Any:
    """Return the unchecked data of a scene; add missing step and duration to a constant scene.

    A static scene with constant loads has a single state. If only step or duration is given, the
    other is equal to it; if both are absent, both are 1 s.
    """
    time = data.get("time") if isinstance(data, dict) else None
    if not isinstance(time, dict) or time.get("integrator") != STATIC:
        return data
    if any(_varies(data.get(name)) for name in LOADS):
        return data
    single = time.get("step", time.get("duration", 1.0))
    return {**data, "time": {"step": single, "duration": single, **time}}


def _varies(value: Any) -> bool:
    """Return whether unchecked tables have a key of a load that varies over time."""
    if isinstance(value, list | tuple):
        return any(map(_varies, value))
    # the start of a load is a number, the start of a body is a table
    return isinstance(value, dict) and any(
        (name in TIME_KEYS and not isinstance(inner, dict)) or _varies(inner)
        for name, inner in value.items()
    )


def unlike_the_integrator(scene: Any) -> Iterator[Broken]:
    """Yield the broken rules between the integrator and other tables."""
    integrator = scene.time.integrator
    if integrator not in IMPLICIT:
        words = f'is for time.integrator = "implicit-euler" or "bdf2" only, not "{integrator}"'
        if scene.material.retardation_time:
            yield "material", rule(f"retardation_time {words}")
        if scene.self_contact:
            yield "self_contact", rule(words)
        elif scene.touching:
            yield "obstacle", rule(f'response = "barrier" {words}')
    if integrator == STATIC:
        yield from _broken_by_statics(scene)
    # "exchange" moves nodes back: that spoils BDF2's history, and nodes pass each other
    if integrator == "bdf2" or scene.touching:
        for number, obstacle in enumerate(scene.obstacle):
            if obstacle.response == "exchange":
                words = (
                    f'may not have response = "exchange" with "bdf2" or surface contact, as '
                    f'obstacle.{number} has: use response = "reflect" or "penalty"'
                )
                yield "obstacle", rule(words)


def _broken_by_statics(scene: Any) -> Iterator[Broken]:
    """Yield the broken rules of a static scene: damping, velocities, force functions, impacts."""
    static = f'with time.integrator = "{STATIC}"'
    if scene.material.damping:
        yield "material", rule(f"may have no damping {static}: nothing moves")
    bodies = [("body", f"body.{number}.", body) for number, body in enumerate(scene.body)]
    for key, prefix, tables in [("", "", scene), *bodies]:
        if tables.start is not None and tables.start.moves:
            words = f"{prefix}start may have no velocity, spin, gradient or swirl {static}"
            yield key or "start", rule(words)
        for number, force in enumerate(tables.force):
            if force.function is not None:
                words = (
                    f"{prefix}force.{number} may be no function {static}: it is evaluated at the "
                    "previous state, so the static state would not balance it"
                )
                yield key or "force", rule(words)
    for number, obstacle in enumerate(scene.obstacle):
        if obstacle.response not in ("penalty", "barrier"):
            words = f'obstacle.{number} needs response = "penalty" {static}: nothing strikes it'
            yield "obstacle", rule(words)
        if obstacle.friction:
            words = f"obstacle.{number} may have no friction {static}: it depends on the motion"
            yield "obstacle", rule(words)
