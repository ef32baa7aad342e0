"""The schema of a study file: which scenes are run, and with what. Lists are multiplied with each other."""

import shlex
from typing import Annotated

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from msmpetsc.errors import did_you_mean
from msmpetsc.scene import Count, Integrator, ListOf, Positive, Preset, Table
from msmpetsc.scene_errors import rule

Error = Annotated[float, Field(gt=0, lt=1)]
Override = Annotated[str, Field(min_length=3)]


def _not_empty(values: tuple) -> tuple:
    if not values:
        raise rule("must not be empty")
    return values


def _words(options: str) -> str:
    try:
        shlex.split(options)
    except ValueError as error:
        raise rule(f"cannot be taken apart: {str(error).lower()}") from None
    return options


Options = Annotated[str, AfterValidator(_words)]


class Reference(Table):
    """The run that a scene's motion is measured against: steps so short that it stands for the true motion."""

    integrator: Integrator = Field("verlet", description="how it is stepped")
    step: Positive | None = Field(None, description="implicit-euler: time step [s]")
    substep: Positive | None = Field(None, description="verlet: longest substep [s]; the stability limit's if absent")
    preset: Preset = Field("newton", description="implicit-euler: solver preset")
    error: Error = Field(1e-6, description="implicit-euler: relative error of a step [-]")
    timeout: Positive = Field(600.0, description="longest run [s]")

    @model_validator(mode="after")
    def _fits_together(self) -> "Reference":
        if self.integrator == "implicit-euler" and self.step is None:
            raise rule('needs step for integrator = "implicit-euler"')
        return self


class StudyScene(Table):
    """A scene of the study, and what of it is run and measured."""

    name: str = Field(min_length=1, description="what charts call it")
    file: str = Field(min_length=1, description="scene file, beside the study file")
    set: ListOf[Override] = Field((), description='changes of the scene: "key.path=value"')
    steps: Count | None = Field(None, description="time steps of a case [-]")
    duration: Positive | None = Field(None, description="or: simulated time of a case [s]; the scene's own if absent")
    frame: Positive | None = Field(
        None, description="moments compared with the reference lie this far apart [s]; the scene's time step if absent"
    )
    reference: Reference | None = Field(
        None, description="what the trajectory error is measured against; none if absent"
    )
    true_error: Count | None = Field(None, description="every so many steps the true step error is measured [-]")
    trace: Count | None = Field(None, description="the step whose iterates are followed, in sweeps with trace = true")
    full: bool = Field(False, description="only with --full")

    @field_validator("duration")
    @classmethod
    def _one_length(cls, duration: float | None, info: ValidationInfo) -> float | None:
        if duration is not None and info.data.get("steps") is not None:
            raise rule("must not stand beside steps", "steps")
        return duration


class Sweep(Table):
    """Cases: every choice from each list, for every scene. An empty list leaves what the scene has."""

    scenes: ListOf[str] = Field((), description="names of the scenes; all if absent")
    integrators: ListOf[Integrator] = Field(("implicit-euler",), description="how they are stepped")
    presets: ListOf[Preset] = Field((), description="implicit-euler: solver presets")
    options: ListOf[Options] = Field(("",), description='PETSc options, each one string: "-pc_type icc"')
    cells: ListOf[Count] = Field((), description="numbers of valid cells [-]")
    time_steps: ListOf[Positive] = Field((), description="time steps; of verlet, what is between two frames [s]")
    substeps: ListOf[Positive] = Field((), description="verlet: longest substeps [s]; the stability limit's if absent")
    errors: ListOf[Error] = Field((), description="relative errors of a step aimed at [-]")
    max_iterations: ListOf[Count] = Field((), description="and budgets of outer iterations, beside those errors [-]")
    ranks: ListOf[Count] = Field((1,), description="MPI ranks [-]")
    steps: Count | None = Field(None, description="time steps of these cases in place of the scene's [-]")
    set: ListOf[Override] = Field((), description="further changes of the scenes")
    label: str = Field("", description="what curves are called, in place of preset and options")
    trace: bool = Field(False, description="follow the iterates of the scene's trace step")
    full: bool = Field(False, description="only with --full")

    @field_validator("integrators", "options", "ranks")
    @classmethod
    def _has_some(cls, values: tuple) -> tuple:
        return _not_empty(values)


class Study(Table):
    """A study file."""

    title: str = Field("", description="for the reader")
    repeats: Count = Field(1, description="runs of each case, of which medians are taken [-]")
    timeout: Positive = Field(300.0, description="a run that takes longer is ended, and its case has no figures [s]")
    scene: ListOf[StudyScene] = Field(description="what is run")
    sweep: ListOf[Sweep] = Field(description="how it is run")

    @field_validator("scene")
    @classmethod
    def _names_differ(cls, scenes: tuple[StudyScene, ...]) -> tuple[StudyScene, ...]:
        names = [scene.name for scene in _not_empty(scenes)]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise rule(f"must not have two scenes of the name {twice!r}")
        return scenes

    @field_validator("sweep")
    @classmethod
    def _scenes_are_there(cls, sweeps: tuple[Sweep, ...], info: ValidationInfo) -> tuple[Sweep, ...]:
        names = [scene.name for scene in info.data.get("scene", ())]
        unknown = next(
            (name for sweep in _not_empty(sweeps) for name in sweep.scenes if names and name not in names), None
        )
        if unknown is not None:
            raise rule(f"names a scene {unknown!r} that is not there{did_you_mean(unknown, names)}")
        return sweeps
