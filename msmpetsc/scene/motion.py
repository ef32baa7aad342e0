"""Tables of what moves the body: its start, gravity, pins, anchors, forces."""

from itertools import pairwise
from typing import Annotated, Self

from pydantic import AfterValidator, Discriminator, Field, Tag, field_validator, model_validator

from msmpetsc.scene.body import Region
from msmpetsc.scene.problems import TAGS, rule
from msmpetsc.scene.values import (
    Direction,
    FunctionName,
    ListOf,
    NotNegative,
    Positive,
    Table,
    Vector,
    after_start,
)


class Twist(Table):
    """Turned ever further along an axis through the middle of the rest bounding box."""

    axis: Direction = Field(description="of any length but zero [-]")
    degrees: float = Field(
        lt=1e6,
        gt=-1e6,
        description="turn of the far end against the near one, right-handed about the axis [degrees]",
    )


class Start(Table):
    """How the body is at time 0, if not at rest in its rest shape: scaled, twisted, then scattered.

    Nodes that are pinned or led stay where they are.
    """

    scale: Vector = Field(
        (1.0, 1.0, 1.0),
        description="factors along the axes, about the middle of the rest bounding box: "
        "0 flattens, a negative one mirrors [-]",
    )
    twist: Twist | None = Field(None, description="a turn that grows along an axis")
    scatter: float = Field(
        0.0,
        ge=0,
        le=1,
        description="every node goes so much of the way to a random place in the rest bounding box [-]",
    )
    velocity: Vector = Field((0.0, 0.0, 0.0), description="[m/s]")
    spin: Vector = Field(
        (0.0, 0.0, 0.0), description="angular velocity about the centre of mass [rad/s]"
    )

    @model_validator(mode="after")
    def _is_no_point(self) -> Self:
        if not any(self.scale) and not self.scatter:
            raise rule(
                "scales the body to a point, where springs have no direction; give 0.01 or scatter"
            )
        return self


class Gravity(Table):
    """A uniform field."""

    acceleration: Vector = Field(description="[m/s^2]")


class Pose(Table):
    """A displacement and a turn at a time of a path."""

    time: Positive = Field(description="when it is reached [s]")
    by: Vector = Field((0.0, 0.0, 0.0), description="displacement from the start [m]")
    turn: Vector = Field(
        (0.0, 0.0, 0.0),
        description="turn from the start, right-handed about this vector's direction by its length, also by more than "
        "360 [degrees]",
    )


def _ascending(path: tuple[Pose, ...]) -> tuple[Pose, ...]:
    if any(a.time >= b.time for a, b in pairwise(path)):
        raise rule("must have ascending times")
    return path


Path = Annotated[ListOf[Pose], AfterValidator(_ascending)]

PATH = "from no displacement at time 0 in straight lines through these, and staying at the last"


class Pin(Table):
    """Nodes that stay where they are."""

    region: Region = Field(description="the nodes held")


class ForceTable(Table):
    """A force that changes with time: straight lines between values, the first before them and the last after them."""

    times: ListOf[NotNegative] = Field(description="ascending [s]")
    values: ListOf[Vector] = Field(description="one for each time [N]")

    @model_validator(mode="after")
    def _fits_together(self) -> "ForceTable":
        if any(a >= b for a, b in pairwise(self.times)):
            raise rule("must have ascending times")
        if not self.times or len(self.times) != len(self.values):
            raise rule(
                f"has {len(self.times)} times and {len(self.values)} values: one value a time"
            )
        return self


# of one kind or the other: a plain union would report both for a mistake in one
Total = Annotated[
    Annotated[Vector, Tag(TAGS[0])] | Annotated[ForceTable, Tag(TAGS[1])],
    Discriminator(lambda total: TAGS[isinstance(total, dict | ForceTable)]),
]


class Force(Table):
    """A force on a part of the body."""

    one_of = ("total", "function")
    region: Region = Field(description="the nodes pulled")
    total: Total | None = Field(
        None,
        description="sum over the nodes, spread by mass, always the same, or { times = [s], values = [N] } with "
        "straight lines between [N]",
    )
    function: FunctionName | None = Field(
        None,
        description="name of a force of positions, velocities and time, registered in Python or installed",
    )
    start: float = Field(0.0, description="acts from this time [s]")
    stop: float | None = Field(None, description="acts until this time [s]; to the end if absent")

    _after_start = field_validator("stop")(after_start)

    @property
    def pulls(self) -> bool:
        """Return whether the force is not zero at some time."""
        if self.total is None:
            return True  # a function, which may
        values = self.total.values if isinstance(self.total, ForceTable) else (self.total,)
        return any(map(any, values))


class AnchorTable(Table):
    """Nodes that are led along a path as one rigid body."""

    region: Region = Field(description="the nodes led")
    path: Path = Field(min_length=1, description=f"how they move: {PATH} [s, m, degrees]")
    center: Vector | None = Field(
        None,
        description="point at rest about which they turn, and which the path leads along; if absent the centre of mass "
        "of the nodes [m]",
    )
    stop: Positive | None = Field(None, description="let go at this time [s]; never if absent")
