"""The table of simulated time: steps, integrator, when the run ends."""

from typing import Any, Literal

from pydantic import ConfigDict, Field, ValidationInfo, field_validator

from msmpetsc.scene.problems import rule
from msmpetsc.scene.statics import STATIC
from msmpetsc.scene.values import IntegratorName, Positive, Table, only_for

MOST_STEPS = 10**9


def _wanted_in_motion(schema: dict[str, Any]) -> None:
    """Say in the JSON schema that only statics may do without a step and a duration (``statics.one_state``)."""
    is_static = {"properties": {"integrator": {"const": STATIC}}, "required": ["integrator"]}
    schema.update({"if": is_static, "else": {"required": schema.pop("required")}})


class Time(Table):
    """Simulated time."""

    model_config = ConfigDict(json_schema_extra=_wanted_in_motion)
    step: Positive = Field(description="time step; required but of statics that stay the same if absent [s]")
    duration: Positive = Field(description="simulated time; required but of statics that stay the same if absent [s]")
    integrator: IntegratorName = Field(
        "implicit-euler",
        description="how a step is taken: solved at once, of first or second order; in explicit substeps; or as a "
        "state of equilibrium",
    )
    substep: Positive | None = Field(
        None, description='longest substep of integrator = "verlet"; under the stability limit if absent [s]'
    )

    until: Literal["duration", "rest"] = Field(
        "duration", description="when the run ends: or as soon as all is at rest"
    )
    error: float | None = Field(
        None, gt=0, lt=1, description="of the motion, relative: steps are as long as it allows, all alike if absent [-]"
    )
    shortest: Positive | None = Field(None, description="of the steps that error chooses; step / 1024 if absent [s]")
    longest: Positive | None = Field(None, description="of them; 64 step if absent [s]")

    _has_a_use = field_validator("substep")(only_for("integrator", "verlet"))

    @field_validator("until")
    @classmethod
    def _moves(cls, until: str, info: ValidationInfo) -> str:
        if until == "rest" and info.data.get("integrator") == STATIC:
            raise rule(f'has no meaning for integrator = "{STATIC}": each state is at rest', "integrator")
        return until

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
