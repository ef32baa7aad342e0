"""The schema of a study file (TOML): its scenes, sweeps, methods and maps.

Paths are relative to the study file; times are in seconds. In every table, ``set`` holds overrides
of scenes, and ``error`` is the target of the relative step error. With ``full`` a table counts only
if --full is given.
"""

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

from msmpetsc.app.ranks import MOST_RANKS
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
# an override of the scene as in --set: "key.path=value"
Override = Annotated[str, Field(min_length=3)]
Name = Annotated[str, Field(min_length=1)]
Ranks = Annotated[Count, Field(le=MOST_RANKS)]


def _solver_options(options: str) -> str:
    try:
        refused = unsafe_word(shlex.split(options))
    except ValueError as error:
        raise rule(f"cannot be split into words: {str(error).lower()}") from None
    if refused is not None:
        raise rule(f"has {refused!r}: a file may hold only solver options with plain values")
    return options


def _check_unique(names: list[str], kind: str) -> None:
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise rule(f"must not have two {kind} named {twice!r}")


def _check_known(wanted: Iterable[str], kind: str, names: list[str]) -> None:
    unknown = next((name for name in wanted if name not in names), None)
    if unknown is not None:
        raise rule(f"names an unknown {kind} {unknown!r}{did_you_mean(unknown, names)}")


Options = Annotated[str, AfterValidator(_solver_options)]


class ReferenceRun(Table):
    """The reference run of a scene, whose short steps stand for the true motion.

    With its own ``cells``, many more than the cases have, it stands for the continuous body, and
    surfaces are compared.

    step    : time step of implicit integrators [s]
    substep : upper limit of verlet's substeps [s]; the stability limit if absent
    cells   : number of cells; the case's lattice if absent
    law     : material law; the case's law if absent
    """

    integrator: IntegratorName = "verlet"
    step: Positive | None = None
    substep: Positive | None = None
    cells: Count | None = None
    law: Name | None = None
    preset: PresetName = "newton"
    error: Error = 1e-6
    timeout: Positive = 600.0

    @model_validator(mode="after")
    def _fits_together(self) -> "ReferenceRun":
        if self.integrator != "verlet" and self.step is None:
            raise rule(f'needs step for integrator = "{self.integrator}"')
        return self


class Length(Table):
    """The length of a run: a number of steps, or a simulated time [s]; by default the scene's."""

    steps: Count | None = None
    duration: Positive | None = None

    @field_validator("duration")
    @classmethod
    def _single_length(cls, duration: float | None, info: ValidationInfo) -> float | None:
        if duration is not None and info.data.get("steps") is not None:
            raise rule("must not stand beside steps")
        return duration

    def seconds(self, step: float, usual: float) -> float:
        """Return the simulated time [s] for a step [s]; ``usual`` if no length is given."""
        return self.steps * step if self.steps else self.duration or usual


class StudyScene(Length):
    """A scene of the study, with its length, reference and measurements.

    true_error : number of steps between measurements of the true step error
    """

    name: Name
    file: FileName
    set: ListOf[Override] = ()
    reference: ReferenceRun | None = None
    true_error: Count | None = None
    full: bool = False


class Sweep(Table):
    """The product of lists of options for every scene; an empty list means the scene's value.

    scenes         : names of scenes; all scenes if empty
    options        : sets of PETSc options, each a string: "-pc_type icc"
    laws           : material laws of cases and references; labels of curves name them
    time_steps     : [s]; for verlet the time between frames
    substeps       : upper limits of verlet's substeps [s]; the stability limit if empty
    max_iterations : iteration budgets, each a further case beside ``errors``
    steps          : number of steps in place of the scene's
    label          : label of curves in place of preset and options
    """

    scenes: ListOf[str] = ()
    integrators: ListOf[IntegratorName] = ()
    presets: ListOf[PresetName] = ()
    options: ListOf[Options] = ("",)
    laws: ListOf[Name] = ()
    cells: ListOf[Count] = ()
    time_steps: ListOf[Positive] = ()
    substeps: ListOf[Positive] = ()
    errors: ListOf[Error] = ()
    max_iterations: ListOf[Count] = ()
    ranks: ListOf[Ranks] = (1,)
    steps: Count | None = None
    set: ListOf[Override] = ()
    label: str = ""
    full: bool = False

    @model_validator(mode="after")
    def _has_cases(self) -> "Sweep":
        if not (self.options and self.ranks):
            raise rule("has no cases: options and ranks must not be empty")
        return self


class Method(Table):
    """An integrator with its solver settings, run at every point of the maps.

    Verlet does not use the preset. If ``error`` is absent, the preset's error is the target.
    """

    label: Name
    integrator: IntegratorName = "implicit-euler"
    preset: PresetName = "newton"
    error: Error | None = None
    max_iterations: Count | None = None
    options: Options = ""
    set: ListOf[Override] = ()


class Axis(Table):
    """An axis of a map: a key of the scene, or a template of overrides that contain {value}.

    key      : "material.young_modulus"
    template : "obstacle.0.path=[{time = 1, by = [0, 0, -{value}]}]"
    values   : in the order of the axis
    unit     : unit of the labels; "%" shows 0.2 as 20%, "s" shows 0.01 as 10 ms
    """

    one_of: ClassVar[tuple[str, ...]] = ("key", "template")
    name: Name
    key: str | None = Field(default=None, min_length=1)
    template: ListOf[Override] = ()
    values: ListOf[float] = Field(min_length=1)
    unit: str = ""

    def changes(self, value: float) -> tuple[str, ...]:
        """Return the overrides of the scene for this value."""
        templates = (f"{self.key}={{value}}",) if self.key else self.template
        return tuple(text.replace("{value}", repr(value)) for text in templates)


class MapCase(Length):
    """A named case, a row of a map whose columns are the methods.

    recovers : whether the body should end in its rest shape
    options  : PETSc options of all methods except verlet
    """

    name: Name
    file: FileName
    set: ListOf[Override] = ()
    recovers: bool = False
    options: Options = ""


class Map(Length):
    """A stability map of a scene over two axes, or of named cases.

    methods : labels of methods; all methods if empty
    x, y    : axes from left to right and from bottom to top
    """

    one_of: ClassVar[tuple[str, ...]] = ("file", "case")
    name: Name
    title: str = ""
    file: FileName | None = None
    set: ListOf[Override] = ()
    methods: ListOf[str] = ()
    x: Axis | None = None
    y: Axis | None = None
    case: ListOf[MapCase] = ()
    full: bool = False

    @model_validator(mode="after")
    def _fits_together(self) -> "Map":
        if self.file and not (self.x and self.y):
            raise rule("needs x and y beside file")
        if self.case and (self.x or self.y):
            raise rule("has named cases, so it must not have x and y")
        _check_unique([case.name for case in self.case], "cases")
        return self


class Study(Table):
    """A study file: scenes with sweeps, or methods with maps.

    repeats : runs of each case; the report gives medians of their times
    jobs    : cases at a time, unless --jobs is given
    """

    title: str = ""
    repeats: Count = 1
    timeout: Positive = 300.0
    jobs: Count = 1
    scene: ListOf[StudyScene] = ()
    sweep: ListOf[Sweep] = ()
    method: ListOf[Method] = ()
    map: ListOf[Map] = ()

    @model_validator(mode="after")
    def _fits_together(self) -> "Study":
        if not self.map and not (self.scene and self.sweep):
            raise rule("needs tables scene and sweep, or map: one of them is required")
        if self.map and not self.method:
            raise rule("has maps, so it needs at least one table [[method]]")
        scenes = [scene.name for scene in self.scene]
        methods = [method.label for method in self.method]
        _check_unique(scenes, "scenes")
        _check_unique(methods, "methods")
        _check_unique([map.name for map in self.map], "maps")
        _check_known((name for sweep in self.sweep for name in sweep.scenes), "scene", scenes)
        _check_known((name for map in self.map for name in map.methods), "method", methods)
        return self


def load_study(path: Path) -> Study:
    """Return the checked contents of a study file. Raises InputError that names every problem."""
    data = read_toml(path, "study")
    if {"mesh", "body"} & data.keys() and OF_STUDIES.isdisjoint(data):
        raise InputError(f"{path}: is a scene, no study: msmpetsc run {shlex.quote(str(path))}")
    try:
        return Study.model_validate(data, context={"presets": preset_names()})
    except ValidationError as error:
        raise InputError("\n".join(problem_lines(path, error))) from None
