"""The tables of what stands in the way of the body, and of its surface in its own."""

from typing import Literal

from pydantic import Field, field_validator, model_validator

from msmpetsc.scene.body import MeshTable
from msmpetsc.scene.motion import PATH, Path
from msmpetsc.scene.problems import rule
from msmpetsc.scene.values import (
    Box,
    FunctionName,
    NotNegative,
    Positive,
    Table,
    UnitVector,
    Vector,
    after_start,
)

FRICTION_SPEED = (
    "how far a second what friction holds gives way before friction is whole: times a step, its elastic slip; "
    "1% of the smallest body's longest side a second if absent [m/s]"
)

BARRIER = "barrier"  # response
NODES_ALONE = "reflect", "penalty", "exchange"
MET = "box", "sphere", "mesh"  # shapes whose surface may meet that of the bodies

NEEDED = {
    "plane": ("point", "normal"),
    "box": ("box",),
    "sphere": ("center", "radius"),
    "mesh": ("mesh",),
    "function": ("function",),
}


class ObstacleTable(Table):
    """What nodes bounce off or are pressed by: it may move, and be there for a while only."""

    shape: Literal["plane", "box", "sphere", "mesh", "function"] = Field(
        description="kind of obstacle"
    )
    point: Vector | None = Field(None, description="a point of the plane [m]")
    normal: UnitVector | None = Field(
        None, description="of the plane, towards its free side, normalised on reading [-]"
    )
    box: Box | None = Field(
        None, description="two corners of the box, each coordinate of the first the lower [m]"
    )
    center: Vector | None = Field(
        None,
        description="of the sphere, or of a barrier the point at rest about which its path turns [m]",
    )
    radius: Positive | None = Field(None, description="of the sphere [m]")
    mesh: MeshTable | None = Field(
        None, description="a closed surface, of which the inside is meant"
    )
    function: FunctionName | None = Field(
        None,
        description="name of a signed distance to a surface, registered in Python or installed",
    )
    path: Path = Field((), description=f"how it moves: {PATH} [s, m, degrees]")
    start: NotNegative = Field(0.0, description="is there from this time [s]")
    stop: Positive | None = Field(
        None, description="is there until this time [s]; to the end if absent"
    )
    response: Literal["reflect", "penalty", "exchange", "barrier"] = Field(
        "reflect",
        description="what happens on touching: barrier keeps the whole surface out, as [self_contact] says; the others "
        "keep out nodes, and exchange is the paper's",
    )
    restitution: float | None = Field(
        None,
        ge=0,
        le=1,
        description="of nodes that strike: normal speed after over before; 1 if absent [-]",
    )
    stiffness: Positive | None = Field(
        None,
        description='of "penalty": push on a node per depth [N/m]; from the stiffest spring if absent',
    )
    friction: NotNegative | None = Field(
        None, description='of "penalty": Coulomb\'s coefficient; 0 if absent [-]'
    )
    friction_speed: Positive | None = Field(None, description=f'of "penalty": {FRICTION_SPEED}')

    _after_start = field_validator("stop")(after_start)

    @model_validator(mode="after")
    def _fits_together(self) -> "ObstacleTable":
        missing = [name for name in NEEDED[self.shape] if getattr(self, name) is None]
        if missing:
            raise rule(f'needs {" and ".join(missing)} for shape = "{self.shape}"')
        uses: dict[str, tuple[str, ...]] = {
            name: (shape,) for shape, names in NEEDED.items() for name in names
        }
        uses |= dict.fromkeys(("stiffness", "friction", "friction_speed"), ("penalty",))
        uses |= {
            "restitution": ("reflect", "exchange"),
            "stop": NODES_ALONE,
            "center": ("sphere", "barrier"),
        }
        if self.response == BARRIER and (self.shape not in MET or self.start):
            raise rule(
                f'has response = "barrier", which is for {" and ".join(MET)} that are there from the start'
            )
        turns = any(any(pose.turn) for pose in self.path)
        if turns and (self.response != BARRIER or self.center is None):
            raise rule('has a path that turns, which is for response = "barrier" with a center')
        for name, use in uses.items():
            if getattr(self, name) is not None and not {self.shape, self.response} & set(use):
                raise rule(f"has {name}, which is for {' or '.join(map(repr, use))} only")
        return self


class SelfContactTable(Table):
    """The surface does not cross itself, nor one part of it another."""

    distance: Positive | None = Field(
        None,
        description="parts nearer than this push each other [m]; if absent the greatest of 3e-4 of the rest bounding "
        "box's diagonal, the median distance of a coarser surface from the body's own, and 1/64 of a cell or "
        "the least gap at rest if that is less",
    )
    friction: NotNegative = Field(0.0, description="Coulomb's coefficient [-]")
    friction_speed: Positive | None = Field(None, description=FRICTION_SPEED)
    surface: int | None = Field(
        None,
        ge=4,
        lt=2**63,
        description="triangles of a coarser surface that meets itself in its place [-]; the whole surface if absent",
    )
