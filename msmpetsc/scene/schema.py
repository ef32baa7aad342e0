"""The schema of a scene: frozen, validated tables. What a key means and its unit stand in its description."""

import math
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import InitErrorDetails

from msmpetsc.scene.problems import one_of_problems, restated, rule, unknown_name
from msmpetsc.scene.statics import no_impact, no_motion, no_wait


def _nonzero(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(vector):
        raise rule("must not be the zero vector")
    return vector


def _unit(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    longest = max(map(abs, _nonzero(vector)))
    x, y, z = (c / longest for c in vector)  # or the squares of very large or small components leave the range
    length = math.hypot(x, y, z)
    return x / length, y / length, z / length


Positive = Annotated[float, Field(gt=0, lt=1e60)]  # so that its fourth power is still a number
MOST_STEPS = 10**9
MOST_CONTRAST = 1e10  # of parts: at 1e11 errors of 1e-3 were no longer told from rounding
DEFAULT_STIFFENING = 10.0
NotNegative = Annotated[float, Field(ge=0, lt=1e60)]
Count = Annotated[int, Field(gt=0, lt=2**63)]  # TOML's integers have 64 bits
T = TypeVar("T")
ListOf = Annotated[tuple[T, ...], Strict(False)]  # not strict: TOML has lists, no tuples
Vector = Annotated[tuple[float, float, float], Strict(False)]
Direction = Annotated[Vector, AfterValidator(_nonzero)]
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
    """Return a file's name, or numbers of points."""
    if isinstance(value, str) and 0 < len(value) <= 1000:
        return _printable(value)
    numbers = isinstance(value, list | tuple) and all(type(n) is int and 0 <= n < 2**63 for n in value)
    if not numbers or not value:
        raise rule("must be a list of point numbers, from 0, or the name of a file that has them")
    return tuple(value)


def _after_start(cls, stop: float | None, info: ValidationInfo) -> float | None:
    start = info.data.get("start")
    if stop is not None and start is not None and stop <= start:
        raise rule(f"must be > start = {start:g}", "start")
    return stop


def _only_for(key: str, value: str) -> Callable[..., Any]:
    """Return the validator of what has a meaning only where another key of its table has this value."""

    def check(cls, given: Any, info: ValidationInfo) -> Any:
        if info.data.get(key, value) != value:
            raise rule(f'is for {key} = "{value}" only', key)
        return given

    return check


def _known_preset(name: str, info: ValidationInfo) -> str:
    presets = (info.context or {}).get("presets")
    if presets is not None and name not in presets:
        raise unknown_name(presets)
    return name


FileName = Annotated[str, Field(min_length=1, max_length=1000), AfterValidator(_printable)]
Integrator = Literal["implicit-euler", "bdf2", "verlet", "static"]
Preset = Annotated[str, AfterValidator(_known_preset)]
Box = Annotated[tuple[Vector, Vector], Strict(False), AfterValidator(_has_a_volume)]
Painted = Annotated[str | tuple[int, ...], BeforeValidator(_painted)]


class Table(BaseModel):
    """A table of the scene file; ``one_of`` names the keys of which exactly one must be given."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)
    one_of: ClassVar[tuple[str, ...]] = ()

    @model_validator(mode="wrap")
    @classmethod
    def _all_problems(cls, data: Any, handler: Callable[[Any], Any]) -> Any:
        """Add what pydantic does not check, and lose none of what it does."""
        known = list(cls.model_fields)
        problems: list[InitErrorDetails] = one_of_problems(data, cls.one_of, known)
        try:
            table = handler(data)
        except ValidationError as error:
            problems += restated(error, known)
        if problems:
            raise ValidationError.from_exception_data(cls.__name__, problems)
        return table


class Rotate(Table):
    """A turn about the origin."""

    axis: Direction = Field(description="axis of the turn, of any length but zero [-]")
    degrees: float = Field(description="angle, right-handed about the axis [degrees]")


class StepTable(Table):
    """A step of mesh preparation that needs a value."""

    one_of = ("simplify", "rotate")
    simplify: int | None = Field(None, ge=4, lt=2**63, description="triangles to keep [-]")
    rotate: Rotate | None = Field(None, description="turn the surface")


StepName = Literal["merge", "largest_part", "union", "repair", "orient"]


def _step(value: Any) -> str | dict[str, Any]:
    """Return a step name, or a table of one key, checked and plain."""
    if isinstance(value, dict):
        return StepTable.model_validate(value).model_dump(exclude_none=True)
    if not isinstance(value, str):
        raise rule("must be a step name or a table such as { simplify = 5000 }")
    if value in StepTable.one_of:
        raise rule(f"needs a value: {{ {value} = ... }}")
    if value not in get_args(StepName):
        raise unknown_name(get_args(StepName))
    return value


Step = Annotated[str | dict[str, Any], BeforeValidator(_step)]


class Mesh(Table):
    """The closed surface."""

    source: FileName = Field(description="registry name, or path beside or below this file")
    prepare: ListOf[Step] = Field(
        (),
        description="steps in this order: merge, largest_part, union, repair, orient, "
        "{ simplify = triangles [-] }, { rotate = { axis = [x, y, z] [-], degrees = angle [degrees] } }",
    )
    size: Positive | None = Field(None, description="longest side of the bounding box [m]; as in the file if absent")
    base: Vector | None = Field(None, description="where the middle of the bounding box's bottom face stands [m]")


class CagesTable(Table):
    """The grid cells that fill the surface, and how the surface follows them."""

    one_of = ("count", "cell_size")
    count: Count | None = Field(None, description="number of valid cells aimed at [-]")
    cell_size: Positive | None = Field(None, description="edge of a cell [m]")
    method: Literal["exact", "sample"] = Field("exact", description="triangle-box test, or the paper's sample points")
    boundary: Literal["fill", "whole"] = Field(
        "fill",
        description="boundary cells weigh and resist by the share of them that is inside, or whole, as the paper's",
    )
    embedding: Literal["affine", "cages", "mvc"] = Field("affine", description="how the surface follows the nodes")
    smoothing: float = Field(1.0, gt=0, le=1, description='width h of f_h in Eq. 9, with embedding = "cages" [cells]')
    max_cells: Count = Field(5_000_000, description="refuse a lattice of more cells than this [-]")

    _has_a_use = field_validator("smoothing")(_only_for("embedding", "cages"))


class Material(Table):
    """What the lattice is made of."""

    one_of = ("young_modulus", "stiffness")
    young_modulus: Positive | None = Field(None, description="Young's modulus; Poisson's ratio is 1/4 [Pa]")
    stiffness: Positive | None = Field(None, description="the same stiffness for every spring [N/m]")
    density: Positive = Field(description="mass density [kg/m^3]")
    law: Literal["linear", "stiffening"] = Field("linear", description="how a spring pulls at large strain")
    stiffening: Positive | None = Field(
        None, description='b of law = "stiffening", a pull of k r (s + b s^3) at strain s; 10 if absent [-]'
    )

    _has_a_use = field_validator("stiffening")(_only_for("law", "stiffening"))

    @property
    def law_stiffening(self) -> float:
        """b of the springs' law, 0 for Hooke's."""
        return 0.0 if self.law == "linear" else self.stiffening or DEFAULT_STIFFENING


class Time(Table):
    """Simulated time."""

    step: Positive = Field(description="time step [s]")
    duration: Positive = Field(description="simulated time [s]")
    integrator: Integrator = Field(
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

    _has_a_use = field_validator("substep")(_only_for("integrator", "verlet"))
    _moves = field_validator("until")(no_wait)

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
        """Number of time steps."""
        return round(self.duration / self.step)


class Twist(Table):
    """Turned ever further along an axis through the middle of the rest bounding box."""

    axis: Direction = Field(description="of any length but zero [-]")
    degrees: float = Field(
        lt=1e6, gt=-1e6, description="turn of the far end against the near one, right-handed about the axis [degrees]"
    )


class Start(Table):
    """How the body is at time 0, if not at rest in its rest shape; scale, twist, scatter in this order.

    Nodes that are pinned or led stay where they are.
    """

    scale: Vector = Field(
        (1.0, 1.0, 1.0),
        description="factors along the axes, about the middle of the rest bounding box: "
        "0 collapses, a negative one mirrors [-]",
    )
    twist: Twist | None = Field(None, description="a turn that grows along an axis")
    scatter: float = Field(
        0.0, ge=0, le=1, description="every node goes so much of the way to a random place in the rest bounding box [-]"
    )
    velocity: Vector = Field((0.0, 0.0, 0.0), description="[m/s]")
    spin: Vector = Field((0.0, 0.0, 0.0), description="angular velocity about the centre of mass [rad/s]")


class Gravity(Table):
    """A uniform field."""

    acceleration: Vector = Field(description="[m/s^2]")


class Keyframe(Table):
    """A place on a path."""

    time: Positive = Field(description="when it is reached [s]")
    by: Vector = Field(description="displacement from the start [m]")


def _ascending(path: tuple[Keyframe, ...]) -> tuple[Keyframe, ...]:
    if any(a.time >= b.time for a, b in pairwise(path)):
        raise rule("must have ascending times")
    return path


Path3 = Annotated[ListOf[Keyframe], AfterValidator(_ascending)]
PATH = "from no displacement at time 0 in straight lines through these, and staying at the last"


class ObstacleTable(Table):
    """What nodes bounce off or are pressed by: a plane, or a box; it may move, and act for a while only."""

    shape: Literal["plane", "box"] = Field(description="kind of obstacle")
    point: Vector | None = Field(None, description="a point of the plane [m]")
    normal: UnitVector | None = Field(
        None, description="of the plane, towards its free side, normalised on reading [-]"
    )
    box: Box | None = Field(None, description="two corners of the box, each coordinate of the first the lower [m]")
    path: Path3 = Field((), description=f"how it moves: {PATH} [s, m]")
    start: NotNegative = Field(0.0, description="is there from this time [s]")
    stop: Positive | None = Field(None, description="is there until this time [s]; to the end if absent")
    response: Literal["reflect", "penalty"] = Field("reflect", description="what happens on touching")
    restitution: float | None = Field(
        None, ge=0, le=1, description='of "reflect": normal speed after over before the impact; 1 if absent [-]'
    )
    stiffness: Positive | None = Field(
        None, description='of "penalty": push on a node per depth [N/m]; from the stiffest spring if absent'
    )
    friction: NotNegative | None = Field(None, description='of "penalty": Coulomb\'s coefficient; 0 if absent [-]')

    _after_start = field_validator("stop")(_after_start)

    @model_validator(mode="after")
    def _fits_together(self) -> "ObstacleTable":
        needed = ("box",) if self.shape == "box" else ("point", "normal")
        missing = [name for name in needed if getattr(self, name) is None]
        if missing:
            raise rule(f'needs {" and ".join(missing)} for shape = "{self.shape}"')
        uses = {"point": "plane", "normal": "plane", "box": "box"}
        uses |= {"restitution": "reflect", "stiffness": "penalty", "friction": "penalty"}
        for name, use in uses.items():
            if getattr(self, name) is not None and use not in (self.shape, self.response):
                raise rule(f"has {name}, which is for {use!r} only")
        return self


class Sphere(Table):
    """A ball."""

    center: Vector = Field(description="[m], or [-] if relative")
    radius: Positive = Field(description="[m], or in longest sides of the rest bounding box [-] if relative")


class HalfSpace(Table):
    """All that lies on one side of a plane."""

    point: Vector = Field(description="a point of the plane [m], or [-] if relative")
    normal: UnitVector = Field(description="towards the side that is meant, normalised on reading [-]")


class Region(Table):
    """A part of space at rest; the nodes in it are meant, or of a part the cells whose centres it holds."""

    one_of = ("box", "sphere", "half_space", "painted")
    box: Box | None = Field(
        None, description="two corners, each coordinate of the first the lower [m], or [-] if relative"
    )
    sphere: Sphere | None = Field(None, description="a ball [m], or [-] if relative")
    half_space: HalfSpace | None = Field(None, description="one side of a plane [m], or [-] if relative")
    painted: Painted | None = Field(
        None,
        description="numbers, from 0, of points of the prepared surface (/surface/points of the result), or a "
        "text file beside this file that lists them: the cells they lie in are meant, or their corners [-]",
    )
    relative: bool = Field(False, description="coordinates run 0..1 along each axis of the rest bounding box")

    @field_validator("relative")
    @classmethod
    def _has_a_use(cls, relative: bool, info: ValidationInfo) -> bool:
        if relative and info.data.get("painted") is not None:
            raise rule("has no meaning for painted points", "painted")
        return relative


class PartTable(Table):
    """Cells of another material; of two parts that hold a cell, the last that gives a key has its say."""

    region: Region = Field(description="the cells whose centres lie in it")
    density: Positive | None = Field(None, description="mass density; the material's if absent [kg/m^3]")
    young_modulus: Positive | None = Field(None, description="Young's modulus; the material's if absent [Pa]")
    stiffness: Positive | None = Field(
        None, description="of springs; one between cells of several parts has the mean of its cells' [N/m]"
    )

    @model_validator(mode="after")
    def _says_something(self) -> "PartTable":
        if self.density is None and self.young_modulus is None and self.stiffness is None:
            raise rule("needs density, young_modulus or stiffness")
        return self


def _as_the_material(cls, parts: tuple[PartTable, ...], info: ValidationInfo) -> tuple[PartTable, ...]:
    """Stiffness and Young's modulus are two ways to name all springs: parts must take the material's."""
    material = info.data.get("material")
    for number, part in enumerate(parts):
        for name in Material.one_of:
            if material is not None and getattr(part, name) is not None and getattr(material, name) is None:
                raise rule(f"may give {name} only where material does, as part.{number} does", "material")
    for name in (*Material.one_of, "density"):
        values = [value for table in (material, *parts) if (value := getattr(table, name, None)) is not None]
        if values and max(values) > MOST_CONTRAST * min(values):
            raise rule(
                f"has {name} of {min(values):g} to {max(values):g} in one body: more than {MOST_CONTRAST:g} to 1 "
                "cannot be solved in double precision (1e6 to 1 is as good as rigid)"
            )
    return parts


class Pin(Table):
    """Nodes that stay where they are."""

    region: Region = Field(description="the nodes held")


class Force(Table):
    """A force on a part of the body."""

    region: Region = Field(description="the nodes pulled")
    total: Vector = Field(description="sum over the nodes, spread by mass [N]")
    start: float = Field(0.0, description="acts from this time [s]")
    stop: float | None = Field(None, description="acts until this time [s]; to the end if absent")

    _after_start = field_validator("stop")(_after_start)


class AnchorTable(Table):
    """Nodes that are led along a path, each keeping its place among them."""

    region: Region = Field(description="the nodes led")
    path: Path3 = Field(min_length=1, description=f"how they move: {PATH} [s, m]")
    stop: Positive | None = Field(None, description="let go at this time [s]; never if absent")


class Solver(Table):
    """How a step is solved."""

    preset: Preset = Field("newton", min_length=1, description="named set of PETSc options")
    error: float | None = Field(None, gt=0, lt=1, description="relative error of a step to aim at [-]")
    max_iterations: Count | None = Field(None, description="outer iterations allowed in a step [-]")


class Safety(Table):
    """What is done about a step that fails."""

    on_failure: Literal["stop", "substep", "fallback"] = Field(
        "stop", description="stop the run; take that step in shorter ones; or solve it with a slower, robust method"
    )


class Output(Table):
    """What is stored beside the lattice."""

    surface: bool = Field(True, description="store the surface of every frame")
    every: Count = Field(1, description="store every N-th step only, and the last [-]")


class Budget(Table):
    """The surface error that a plan expects: rms over surface and time, of the largest displacement."""

    target: Positive = Field(description="asked for [-]")
    cells: NotNegative = Field(description="of the cells [-]")
    time: NotNegative = Field(description="of the time step [-]")
    step: NotNegative = Field(description="of the steps' solution [-]")
    count: Count = Field(description="number of cells that it was estimated for [-]")
    time_step: Positive = Field(description="time step that it was estimated for [s]")


class Picture(Table):
    """How the result is drawn."""

    eye: Direction | None = Field(
        None, description="direction from the body to the eye, of any length; across its longer side if absent [-]"
    )
    times: ListOf[NotNegative] = Field(
        (), description="moments drawn beside the start [s]; chosen by their energies if absent"
    )


class SceneFile(Table):
    """What may stand in a scene file; ``SceneFile.model_json_schema()`` is its schema."""

    title: str = Field("", description="for the reader")
    mesh: Mesh = Field(description="the closed surface")
    cages: CagesTable = Field(description="the cells that fill it")
    material: Material = Field(description="what it is made of")
    part: ListOf[PartTable] = Field((), description="cells of another material")
    time: Time = Field(description="time step and duration")
    start: Start | None = Field(None, description="how it is at time 0; at rest in its rest shape if absent")
    gravity: Gravity | None = Field(None, description="a uniform field; none if absent")
    obstacle: ListOf[ObstacleTable] = Field((), description="what nodes bounce off")
    pin: ListOf[Pin] = Field((), description="nodes that stay where they are")
    anchor: ListOf[AnchorTable] = Field((), description="nodes led along a path")
    force: ListOf[Force] = Field((), description="forces on parts of the body")
    solver: Solver = Field(Solver.model_validate({}), description="how a step is solved")
    safety: Safety = Field(Safety.model_validate({}), description="what is done about a step that fails")
    output: Output = Field(Output.model_validate({}), description="what is stored")
    budget: Budget | None = Field(None, description="the surface error that `plan` expects; for the reader")
    picture: Picture = Field(Picture.model_validate({}), description="how the result is drawn")

    _of_one_kind = field_validator("part")(_as_the_material)
    _starts_at_rest = field_validator("start")(no_motion)
    _only_presses = field_validator("obstacle")(no_impact)

    @property
    def stored(self) -> int:
        """Number of frames, frame 0 included."""
        return self.stored_until(self.time.steps)

    def stored_until(self, step: int) -> int:
        """Number of frames of the first steps: one for every ``every``-th and for the last."""
        every = self.output.every
        return 1 + (-(-step // every) if step == self.time.steps else step // every)

    def named_files(self) -> Iterator[tuple[tuple[str | int, ...], str]]:
        """Key path and name of each file that it names; a mesh's name may be one of the registry's too."""
        yield ("mesh", "source"), self.mesh.source
        for kind in ("part", "pin", "anchor", "force"):
            for number, table in enumerate(getattr(self, kind)):
                if isinstance(table.region.painted, str):
                    yield (kind, number, "region", "painted"), table.region.painted


class Scene(SceneFile):
    """A scene file as read: its tables, its TOML text as run, and the folder its paths start from."""

    text: str = Field("", description="the TOML text, overrides included")
    folder: Path = Field(Path(), description="folder of the file")
