"""The schema of a study file: which scenes are run, and with what; and how it is read (TOML)."""

import shlex
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import AfterValidator, Field, ValidationError, ValidationInfo, field_validator, model_validator

from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.scene.problems import problem_lines, rule
from msmpetsc.scene.reading import OF_STUDIES, read_toml
from msmpetsc.scene.values import Count, FileName, IntegratorName, ListOf, Positive, PresetName, Table
from msmpetsc.solve.petsc.words import unsafe_word

Error = Annotated[float, Field(gt=0, lt=1)]
Override = Annotated[str, Field(min_length=3)]


def _words(options: str) -> str:
    try:
        refused = unsafe_word(shlex.split(options))
    except ValueError as error:
        raise rule(f"cannot be taken apart: {str(error).lower()}") from None
    if refused is not None:
        raise rule(f"has {refused!r}: only options of solvers, and plain values, may stand in a file")
    return options


def _differ(names: list[str], what: str) -> None:
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise rule(f"must not have two {what} of the name {twice!r}")


def _known(wanted: Iterable[str], what: str, names: list[str]) -> None:
    """Refuse ``wanted`` names that no scene, or no method, of this study has; ``what``: "scene" or "method"."""
    unknown = next((name for name in wanted if name not in names), None)
    if unknown is not None:
        raise rule(f"names a {what} {unknown!r} that is not there{did_you_mean(unknown, names)}")


Options = Annotated[str, AfterValidator(_words)]


class ReferenceRun(Table):
    """The run that a scene's motion is measured against, with steps so short that it stands for the true motion.

    With cells of its own, many more than the cases have, it stands for the body itself, and surfaces are compared.
    """

    integrator: IntegratorName = Field(default="verlet", description="how it is stepped")
    step: Positive | None = Field(default=None, description="implicit-euler: time step [s]")
    substep: Positive | None = Field(
        default=None, description="verlet: longest substep [s]; the stability limit's if absent"
    )
    cells: Count | None = Field(
        default=None,
        description="number of its own valid cells: then surfaces are compared; the case's own lattice if absent [-]",
    )
    preset: PresetName = Field(default="newton", description="implicit-euler: solver preset")
    error: Error = Field(default=1e-6, description="implicit-euler: relative error of a step [-]")
    timeout: Positive = Field(default=600.0, description="longest run [s]")

    @model_validator(mode="after")
    def _fits_together(self) -> "ReferenceRun":
        if self.integrator != "verlet" and self.step is None:
            raise rule(f'needs step for integrator = "{self.integrator}"')
        return self


class Length(Table):
    """The length of a run."""

    steps: Count | None = Field(default=None, description="time steps of a run [-]")
    duration: Positive | None = Field(default=None, description="or: simulated time [s]; the scene's own if absent")

    @field_validator("duration")
    @classmethod
    def _single_length(cls, duration: float | None, info: ValidationInfo) -> float | None:
        if duration is not None and info.data.get("steps") is not None:
            raise rule("must not stand beside steps", "steps")
        return duration


class StudyScene(Length):
    """A scene of the study, and what of it is run and measured."""

    name: str = Field(min_length=1, description="what charts call it")
    file: FileName = Field(description="scene file, a path from the study file")
    set: ListOf[Override] = Field(default=(), description='changes of the scene: "key.path=value"')
    frame: Positive | None = Field(
        default=None,
        description="moments compared with the reference lie this far apart [s]; the scene's time step if absent",
    )
    reference: ReferenceRun | None = Field(
        default=None,
        description="what the trajectory error, or with cells of its own the surface error, is measured against",
    )
    true_error: Count | None = Field(
        default=None, description="every so many steps the true step error is measured [-]"
    )
    trace: Count | None = Field(
        default=None, description="the step whose iterates are followed, in sweeps with trace = true"
    )
    full: bool = Field(default=False, description="only with --full")


class Sweep(Table):
    """Cases of every choice from each list, for every scene. An empty list leaves what the scene has."""

    scenes: ListOf[str] = Field(default=(), description="names of the scenes; all if absent")
    integrators: ListOf[IntegratorName] = Field(default=("implicit-euler",), description="how they are stepped")
    presets: ListOf[PresetName] = Field(default=(), description="implicit-euler: solver presets")
    options: ListOf[Options] = Field(default=("",), description='PETSc options, each one string: "-pc_type icc"')
    cells: ListOf[Count] = Field(default=(), description="numbers of valid cells [-]")
    time_steps: ListOf[Positive] = Field(
        default=(), description="time steps; of verlet, what is between two frames [s]"
    )
    substeps: ListOf[Positive] = Field(
        default=(), description="verlet: longest substeps [s]; the stability limit's if absent"
    )
    errors: ListOf[Error] = Field(default=(), description="relative errors of a step aimed at [-]")
    max_iterations: ListOf[Count] = Field(
        default=(), description="and budgets of outer iterations, beside those errors [-]"
    )
    ranks: ListOf[Count] = Field(default=(1,), description="MPI ranks [-]")
    steps: Count | None = Field(default=None, description="time steps of these cases in place of the scene's [-]")
    set: ListOf[Override] = Field(default=(), description="further changes of the scenes")
    label: str = Field(default="", description="what curves are called, in place of preset and options")
    trace: bool = Field(default=False, description="follow the iterates of the scene's trace step")
    full: bool = Field(default=False, description="only with --full")

    @model_validator(mode="after")
    def _has_cases(self) -> "Sweep":
        if not (self.integrators and self.options and self.ranks):
            raise rule("has no cases: integrators, options and ranks must not be empty")
        return self


class Method(Table):
    """A way to step and solve the scenes of maps."""

    label: str = Field(min_length=1, description="what maps call it")
    integrator: IntegratorName = Field(default="implicit-euler", description="how it is stepped")
    preset: PresetName = Field(default="newton", description="solver preset; of no use to verlet")
    error: Error | None = Field(
        default=None, description="relative error of a step aimed at; the preset's if absent [-]"
    )
    max_iterations: Count | None = Field(default=None, description="outer iterations allowed in a step [-]")
    options: Options = Field(default="", description="PETSc options")


class Axis(Table):
    """A side of a map: a key of the scene that changes along it, or several changes that name their {value}."""

    one_of: ClassVar[tuple[str, ...]] = ("key", "template")
    name: str = Field(min_length=1, description="what it is, for the reader")
    key: str | None = Field(default=None, min_length=1, description='what is set: "material.young_modulus"')
    template: ListOf[Override] = Field(
        default=(), description='or changes: "obstacle.0.path=[{time = 1, by = [0, 0, -{value}]}]"'
    )
    values: ListOf[float] = Field(min_length=1, description="in the order of the axis")
    unit: str = Field(default="", description='for the reader; "%" shows 0.2 as 20% and s as 10 ms')

    def changes(self, value: float) -> tuple[str, ...]:
        """Return overrides of the scene at this value."""
        templates = (f"{self.key}={{value}}",) if self.key else self.template
        return tuple(text.replace("{value}", repr(value)) for text in templates)


class MapCase(Length):
    """A named case: a line of a map whose columns are the methods."""

    name: str = Field(min_length=1, description="what the map calls it")
    file: FileName = Field(description="scene file, a path from the study file")
    set: ListOf[Override] = Field(default=(), description='changes of the scene: "key.path=value"')
    recovers: bool = Field(default=False, description="the body should be in its rest shape at the end")
    options: Options = Field(default="", description="PETSc options for all methods that solve")


class Map(Length):
    """A map of what happens to a scene over two axes, a panel a method; or to named cases, a column a method."""

    one_of: ClassVar[tuple[str, ...]] = ("file", "case")
    name: str = Field(min_length=1, description="of its files and of its rows")
    title: str = Field(default="", description="for the reader; the name if absent")
    file: FileName | None = Field(default=None, description="scene file, a path from the study file")
    set: ListOf[Override] = Field(default=(), description='changes of the scene: "key.path=value"')
    methods: ListOf[str] = Field(default=(), description="labels of the methods; all if absent")
    x: Axis | None = Field(default=None, description="what changes from left to right")
    y: Axis | None = Field(default=None, description="what changes from bottom to top")
    case: ListOf[MapCase] = Field(default=(), description="or: named cases")
    full: bool = Field(default=False, description="only with --full")

    @model_validator(mode="after")
    def _fits_together(self) -> "Map":
        if self.file and not (self.x and self.y):
            raise rule("needs x and y beside file")
        if self.case and (self.x or self.y):
            raise rule("has cases: x and y are of no use")
        _differ([case.name for case in self.case], "cases")
        return self


class Order(Table):
    """A scene whose sweep over time steps is drawn as the order of the integrators."""

    scene: str = Field(min_length=1, description="name of the scene; it needs a reference")
    frequency: Positive | None = Field(
        default=None, description="of its slowest vibration, for implicit Euler's loss [Hz]"
    )


class Study(Table):
    """A study file."""

    title: str = Field(default="", description="for the reader")
    repeats: Count = Field(default=1, description="runs of each case, of which medians are taken [-]")
    timeout: Positive = Field(
        default=300.0, description="a run that takes longer is ended, and its case has no figures [s]"
    )
    jobs: Count = Field(default=1, description="cases at a time, unless --jobs says otherwise [-]")
    scene: ListOf[StudyScene] = Field(default=(), description="what is run")
    sweep: ListOf[Sweep] = Field(default=(), description="how it is run")
    method: ListOf[Method] = Field(default=(), description="the methods of maps")
    map: ListOf[Map] = Field(default=(), description="what happens where")
    order: ListOf[Order] = Field(default=(), description="scenes that show the order of the integrators")

    @model_validator(mode="after")
    def _fits_together(self) -> "Study":
        if not self.map and not (self.scene and self.sweep):
            raise rule("needs scene and sweep, or map: one of them is required")
        if self.map and not self.method:
            raise rule("needs methods for its maps: [[method]]")
        scenes, methods = [scene.name for scene in self.scene], [method.label for method in self.method]
        maps = [map.name for map in self.map]
        for names, what in ((scenes, "scenes"), (methods, "methods"), (maps, "maps")):
            _differ(names, what)
        _known((name for sweep in self.sweep for name in sweep.scenes), "scene", scenes)
        _known((order.scene for order in self.order), "scene", scenes)
        _known((name for map in self.map for name in map.methods), "method", methods)
        return self


def load_study(path: Path, presets: Collection[str] | None = None) -> Study:
    """Read and check a study file; ``presets`` are the names known, any will do if None.

    Raises InputError naming every problem, one a line.
    """
    text, data = read_toml(path, "study")
    if {"mesh", "body"} & data.keys() and OF_STUDIES.isdisjoint(data):
        raise InputError(f"{path}: is a scene, no study: msmpetsc run {path}")
    try:
        return Study.model_validate(data, context={"presets": presets})
    except ValidationError as error:
        raise InputError("\n".join(problem_lines(path, error, text, {}))) from None
