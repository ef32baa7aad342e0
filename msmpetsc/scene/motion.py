"""Scene tables of motion and loads: start, gravity, pins, anchors and forces."""

from itertools import pairwise
from typing import Annotated, Self

from pydantic import AfterValidator, Discriminator, Field, Tag, field_validator, model_validator

from msmpetsc.scene.body import Region
from msmpetsc.scene.problems import TAGS, rule
from msmpetsc.scene.values import (
    Components,
    FileName,
    FunctionName,
    ListOf,
    Matrix,
    NotNegative,
    Positive,
    Table,
    UnitVector,
    Vector,
    after_start,
    refuse_unlike,
)


class Twist(Table):
    """A rotation that grows along an axis through the centre of the rest bounding box."""

    axis: UnitVector = Field(description="twist axis of any nonzero length [-]")
    degrees: float = Field(
        lt=1e6,
        gt=-1e6,
        description="rotation of the far end relative to the near end, right-handed about the "
        "axis [degrees]",
    )


class Swirl(Table):
    """An angular velocity about an axis, piecewise linear along it, constant beyond the table."""

    axis: UnitVector = Field(description="axis through start.about, of any nonzero length [-]")
    distances: ListOf[float] = Field(description="ascending distances along the axis [m]")
    rates: ListOf[float] = Field(
        description="angular velocity at each distance, right-handed about the axis [rad/s]"
    )

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        refuse_unlike(self.distances, self.rates, "distances", "rates")
        return self


class Start(Table):
    """The state of a body at time 0: its rest shape scaled, then twisted, then scattered.

    Pinned and anchored nodes stay at their rest positions without velocity. With ``from``, the last
    state of another run takes the place of the rest shape, also for pinned nodes; velocities are
    added.
    """

    from_: FileName | None = Field(
        None,
        alias="from",
        description="result file of a run of the same lattice, in or below the scene's folder; its "
        "last state takes the place of the rest shape at rest",
    )
    scale: Vector = Field(
        (1.0, 1.0, 1.0),
        description="scale factors along x, y, z about the centre of the rest bounding box; "
        "0 flattens, a negative factor mirrors [-]",
    )
    twist: Twist | None = Field(None, description="a rotation that grows along an axis")
    scatter: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of the way that each node moves to a random point of the rest "
        "bounding box [-]",
    )
    velocity: Vector = Field((0.0, 0.0, 0.0), description="velocity of all nodes [m/s]")
    spin: Vector = Field((0.0, 0.0, 0.0), description="angular velocity about start.about [rad/s]")
    gradient: Matrix | None = Field(
        None, description="rows of G, for the velocity G (x - about) at a position x [1/s]"
    )
    swirl: Swirl | None = Field(None, description="an angular velocity that varies along an axis")
    about: Vector | None = Field(
        None,
        description="point about which spin, gradient and swirl act [m]; the centre of mass if "
        "absent",
    )

    @property
    def moves(self) -> bool:
        """Return whether the table gives a velocity."""
        turns = any(self.spin) or self.gradient is not None or self.swirl is not None
        return any(self.velocity) or turns

    @model_validator(mode="after")
    def _is_no_point(self) -> Self:
        is_scaled = self.scale != (1.0, 1.0, 1.0)
        if self.from_ is not None and (is_scaled or self.twist is not None or self.scatter):
            raise rule("has from, whose shape may not be scaled, twisted or scattered")
        if not any(self.scale) and not self.scatter:
            raise rule(
                "scales the body to a point, where springs have no direction; give 0.01 or scatter"
            )
        return self


class Gravity(Table):
    """Uniform gravity."""

    acceleration: Vector = Field(description="gravitational acceleration [m/s^2]")


class Pose(Table):
    """A displacement and a rotation at a time of a path."""

    time: Positive = Field(description="time at which the pose is reached [s]")
    by: Vector = Field((0.0, 0.0, 0.0), description="displacement since time 0 [m]")
    turn: Vector = Field(
        (0.0, 0.0, 0.0),
        description="rotation vector since time 0: right-handed about its direction, its length "
        "is the angle, which may exceed 360 [degrees]",
    )


def _ascending(path: tuple[Pose, ...]) -> tuple[Pose, ...]:
    if any(a.time >= b.time for a, b in pairwise(path)):
        raise rule("must have ascending times")
    return path


Path = Annotated[ListOf[Pose], AfterValidator(_ascending)]

PATH = "poses, interpolated linearly from rest at time 0; the last pose is kept"


class Holder(Table):
    """Nodes with held components, which are no unknowns."""

    fix: Components = Field(
        ("x", "y", "z"),
        description='global components that are held, for example ["x"] for a roller or a plane '
        "of symmetry [-]",
    )

    @property
    def fixed(self) -> tuple[bool, ...]:
        """Return whether each component is fixed."""
        return tuple(axis in self.fix for axis in "xyz")


class Pin(Holder):
    """Nodes that stay at their rest positions."""

    region: Region = Field(description="the pinned nodes")


class ForceTable(Table):
    """A force that is piecewise linear in time, and constant before and after the table."""

    times: ListOf[NotNegative] = Field(description="ascending times [s]")
    values: ListOf[Vector] = Field(description="force [N] or traction [Pa] at each time")

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        refuse_unlike(self.times, self.values, "times", "values")
        return self


class PressureTable(ForceTable):
    """A pressure that is piecewise linear in time, and constant before and after the table."""

    values: ListOf[float] = Field(description="pressure at each time [Pa]")  # type: ignore[assignment]


# a tagged union: a plain union would report the problems of both alternatives
Total = Annotated[
    Annotated[Vector, Tag(TAGS[0])] | Annotated[ForceTable, Tag(TAGS[1])],
    Discriminator(lambda total: TAGS[isinstance(total, dict | ForceTable)]),
]


class Force(Table):
    """A force on the nodes of a region."""

    one_of = ("total", "function")
    region: Region = Field(description="the nodes that the force acts on")
    total: Total | None = Field(
        None,
        description="total force, distributed over the nodes by mass: a constant vector, or "
        "{ times = [s], values = [N] }, interpolated linearly [N]",
    )
    function: FunctionName | None = Field(
        None,
        description="name of a force function of positions, velocities and time, registered in "
        "Python or installed",
    )
    start: float = Field(0.0, description="time from which the force acts [s]")
    stop: float | None = Field(
        None, description="time until which the force acts [s]; to the end if absent"
    )

    _after_start = field_validator("stop")(after_start)

    @property
    def pulls(self) -> bool:
        """Return whether the force may be nonzero at some time."""
        if self.total is None:
            return True
        values = self.total.values if isinstance(self.total, ForceTable) else (self.total,)
        return any(map(any, values))


class SurfaceLoad(Table):
    """A load on the surface triangles of a region, chosen by their centroids or their group."""

    region: Region = Field(
        description="the triangles of the surface that the load acts on, by their centroids or by "
        "their group"
    )
    start: float = Field(0.0, description="time from which the load acts [s]")
    stop: float | None = Field(
        None, description="time until which the load acts [s]; to the end if absent"
    )

    _after_start = field_validator("stop")(after_start)

    @field_validator("region")
    @classmethod
    def _has_triangles(cls, region: Region) -> Region:
        if region.painted is not None:
            raise rule("must be a box, sphere, half_space or group: points choose no triangles")
        return region


class Traction(SurfaceLoad):
    """A dead load: a force per area at rest, whose direction does not turn with the surface."""

    value: Total = Field(
        description="traction: a constant vector, or { times = [s], values = [Pa] }, interpolated "
        "linearly [Pa]"
    )


class Pressure(SurfaceLoad):
    """A pressure that follows the surface, which must be closed, or have an edge that pins hold."""

    value: Annotated[
        Annotated[float, Tag(TAGS[0])] | Annotated[PressureTable, Tag(TAGS[1])],
        Discriminator(lambda value: TAGS[isinstance(value, dict | PressureTable)]),
    ] = Field(
        description="pressure, positive if it pushes into the body: a number, or "
        "{ times = [s], values = [Pa] }, interpolated linearly [Pa]"
    )


class AnchorTable(Holder):
    """Nodes that move along a prescribed path as a rigid body."""

    region: Region = Field(description="the nodes that move along the path")
    path: Path = Field(min_length=1, description=f"motion of the nodes: {PATH} [s, m, degrees]")
    center: Vector | None = Field(
        None,
        description="centre of rotation at time 0, which moves along the path [m]; the nodes' "
        "centre of mass if absent",
    )
    stop: Positive | None = Field(
        None, description="time at which the nodes are released [s]; never if absent"
    )
