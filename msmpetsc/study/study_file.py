"""The schema of a study file (TOML): its scenes, sweeps, methods and maps."""

import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import (
    AfterValidator,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.scene.problems import problem_lines, rule
from msmpetsc.scene.reading import OF_STUDIES, read_toml
from msmpetsc.scene.values import (
    Count,
    FileName,
    IntegratorName,
    ListOf,
    Positive,
    PresetName,
    Table,
)
from msmpetsc.solve.petsc.words import unsafe_word
from msmpetsc.solve.presets import preset_names

Error = Annotated[float, Field(gt=0, lt=1)]
Override = Annotated[str, Field(min_length=3)]  # of the scene, as of --set: "key.path=value"
Name = Annotated[str, Field(min_length=1)]


def _words(options: str) -> str:
    try:
        refused = unsafe_word(shlex.split(options))
    except ValueError as error:
        raise rule(f"cannot be taken apart: {str(error).lower()}") from None
    if refused is not None:
        raise rule(
            f"has {refused!r}: only options of solvers, and plain values, may stand in a file"
        )
    return options


def _differ(names: list[str], what: str) -> None:
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise rule(f"must not have two {what} of the name {twice!r}")


def _known(wanted: Iterable[str], what: str, names: list[str]) -> None:
    unknown = next((name for name in wanted if name not in names), None)
    if unknown is not None:
        raise rule(f"names a {what} {unknown!r} that is not there{did_you_mean(unknown, names)}")


Options = Annotated[str, AfterValidator(_words)]


class ReferenceRun(Table):
    """The reference run of a scene, with steps so short that it stands for the true motion.

    With cells of its own, many more than the cases have, it stands for the body itself, and surfaces are compared.
    """

    integrator: IntegratorName = "verlet"
    step: Positive | None = None  # [s] of what is not verlet
    substep: Positive | None = None  # [s] of verlet, the longest; the stability limit's if absent
    cells: Count | None = None  # the case's own lattice if absent
    law: Name | None = None  # of the material; the case's own if absent
    preset: PresetName = "newton"
    error: Error = 1e-6  # of a step, relative
    timeout: Positive = 600.0  # [s]

    @model_validator(mode="after")
    def _fits_together(self) -> "ReferenceRun":
        if self.integrator != "verlet" and self.step is None:
            raise rule(f'needs step for integrator = "{self.integrator}"')
        return self


class Length(Table):
    """The length of a run: time steps, or simulated time [s]; the scene's if both are absent."""

    steps: Count | None = None
    duration: Positive | None = None

    @field_validator("duration")
    @classmethod
    def _single_length(cls, duration: float | None, info: ValidationInfo) -> float | None:
        if duration is not None and info.data.get("steps") is not None:
            raise rule("must not stand beside steps", "steps")
        return duration

    def seconds(self, step: float, usual: float) -> float:
        """Return the simulated time [s] of steps so long; the usual one where neither is given."""
        return self.steps * step if self.steps else self.duration or usual


class StudyScene(Length):
    """A scene of the study, with its length, reference and measurements."""

    name: Name
    file: FileName  # a path from the study file
    set: ListOf[Override] = ()
    frame: Positive | None = (
        None  # [s] between moments compared with the reference; the scene's time step if absent
    )
    reference: ReferenceRun | None = None
    true_error: Count | None = None  # every so many steps the true step error is measured
    full: bool = False  # only with --full


class Sweep(Table):
    """The product of lists of options, run for every scene; an empty list stands for the scene's own value."""

    scenes: ListOf[str] = ()  # names; all if absent
    integrators: ListOf[IntegratorName] = ("implicit-euler",)
    presets: ListOf[PresetName] = ()
    options: ListOf[Options] = ("",)  # of PETSc, each one string: "-pc_type icc"
    laws: ListOf[Name] = ()  # of the material and of references; curves are called by them
    cells: ListOf[Count] = ()
    time_steps: ListOf[Positive] = ()  # [s]; of verlet, what is between two frames
    substeps: ListOf[Positive] = ()  # [s] of verlet, the longest; the stability limit's if absent
    errors: ListOf[Error] = ()  # of a step, aimed at
    max_iterations: ListOf[Count] = ()  # budgets, beside those errors
    ranks: ListOf[Count] = (1,)
    steps: Count | None = None  # in place of the scene's
    set: ListOf[Override] = ()  # further changes of the scenes
    label: str = ""  # what curves are called, in place of preset and options
    full: bool = False  # only with --full

    @model_validator(mode="after")
    def _has_cases(self) -> "Sweep":
        if not (self.integrators and self.options and self.ranks):
            raise rule("has no cases: integrators, options and ranks must not be empty")
        return self


class Method(Table):
    """A way to step and solve the scenes of maps; verlet has no use for a preset."""

    label: Name
    integrator: IntegratorName = "implicit-euler"
    preset: PresetName = "newton"
    error: Error | None = None  # of a step, aimed at; the preset's if absent
    max_iterations: Count | None = None
    options: Options = ""
    set: ListOf[Override] = ()  # changes of every scene, as to another law of the material


class Axis(Table):
    """An axis of a map: a key of the scene, or a template of overrides that contain {value}."""

    one_of: ClassVar[tuple[str, ...]] = ("key", "template")
    name: Name  # for the reader
    key: str | None = Field(default=None, min_length=1)  # what is set: "material.young_modulus"
    template: ListOf[Override] = ()  # or: "obstacle.0.path=[{time = 1, by = [0, 0, -{value}]}]"
    values: ListOf[float] = Field(min_length=1)  # in the order of the axis
    unit: str = ""  # for the reader; "%" shows 0.2 as 20% and "s" as 10 ms

    def changes(self, value: float) -> tuple[str, ...]:
        """Return overrides of the scene at this value."""
        templates = (f"{self.key}={{value}}",) if self.key else self.template
        return tuple(text.replace("{value}", repr(value)) for text in templates)


class MapCase(Length):
    """A named case of a map whose columns are the methods."""

    name: Name
    file: FileName  # a path from the study file
    set: ListOf[Override] = ()
    recovers: bool = False  # the body should be in its rest shape at the end
    options: Options = ""  # of PETSc, for all methods that solve


class Map(Length):
    """A stability map of a scene over two axes, or of named cases."""

    one_of: ClassVar[tuple[str, ...]] = ("file", "case")
    name: Name
    title: str = ""  # for the reader; the name if absent
    file: FileName | None = None  # a path from the study file
    set: ListOf[Override] = ()
    methods: ListOf[str] = ()  # labels; all if absent
    x: Axis | None = None  # from left to right
    y: Axis | None = None  # from bottom to top
    case: ListOf[MapCase] = ()
    full: bool = False  # only with --full

    @model_validator(mode="after")
    def _fits_together(self) -> "Map":
        if self.file and not (self.x and self.y):
            raise rule("needs x and y beside file")
        if self.case and (self.x or self.y):
            raise rule("has cases: x and y are of no use")
        _differ([case.name for case in self.case], "cases")
        return self


class Study(Table):
    """A study file."""

    title: str = ""  # for the reader
    repeats: Count = 1  # of each case, of which medians are taken
    timeout: Positive = 300.0  # [s] of a run
    jobs: Count = 1  # cases at a time, unless --jobs says otherwise
    scene: ListOf[StudyScene] = ()
    sweep: ListOf[Sweep] = ()
    method: ListOf[Method] = ()
    map: ListOf[Map] = ()

    @model_validator(mode="after")
    def _fits_together(self) -> "Study":
        if not self.map and not (self.scene and self.sweep):
            raise rule("needs scene and sweep, or map: one of them is required")
        if self.map and not self.method:
            raise rule("needs methods for its maps: [[method]]")
        scenes = [scene.name for scene in self.scene]
        methods = [method.label for method in self.method]
        _differ(scenes, "scenes")
        _differ(methods, "methods")
        _differ([map.name for map in self.map], "maps")
        _known((name for sweep in self.sweep for name in sweep.scenes), "scene", scenes)
        _known((name for map in self.map for name in map.methods), "method", methods)
        return self


def load_study(path: Path) -> Study:
    """Read and check a study file. Raises InputError naming every problem, one a line."""
    text, data = read_toml(path, "study")
    if {"mesh", "body"} & data.keys() and OF_STUDIES.isdisjoint(data):
        raise InputError(f"{path}: is a scene, no study: msmpetsc run {shlex.quote(str(path))}")
    try:
        return Study.model_validate(data, context={"presets": preset_names()})
    except ValidationError as error:
        raise InputError("\n".join(problem_lines(path, error, text, {}))) from None
