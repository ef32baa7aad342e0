"""Scene tables of contact: obstacles, and contact of the surface with itself."""

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
    "regularisation of friction: slip speed below which friction is elastic, so that the elastic "
    "slip in a step is this speed times the step [m/s]; if absent, 1% of the smallest body's "
    "longest side per second"
)

BARRIER = "barrier"
# responses that act on nodes, not on the surface
NODE_RESPONSES = "reflect", "penalty", "exchange"
# shapes that may have response = "barrier"
BARRIER_SHAPES = "box", "sphere", "mesh"

# required keys of each shape
NEEDED = {
    "plane": ("point", "normal"),
    "box": ("box",),
    "sphere": ("center", "radius"),
    "mesh": ("mesh",),
    "function": ("function",),
}


class ObstacleTable(Table):
    """A solid that bodies touch; it may move, appear and disappear."""

    shape: Literal["plane", "box", "sphere", "mesh", "function"] = Field(
        description="shape of the obstacle"
    )
    point: Vector | None = Field(None, description="a point of the plane [m]")
    normal: UnitVector | None = Field(
        None, description="normal of the plane towards its free side, of any nonzero length [-]"
    )
    box: Box | None = Field(
        None, description="two corners of the box, the lower coordinates first [m]"
    )
    center: Vector | None = Field(
        None, description="centre of the sphere; of a barrier, the centre of rotation at time 0 [m]"
    )
    radius: Positive | None = Field(None, description="radius of the sphere [m]")
    mesh: MeshTable | None = Field(
        None, description="a closed surface whose inside is the obstacle"
    )
    function: FunctionName | None = Field(
        None, description="name of a signed distance function, registered in Python or installed"
    )
    path: Path = Field((), description=f"motion of the obstacle: {PATH} [s, m, degrees]")
    start: NotNegative = Field(0.0, description="time from which the obstacle exists [s]")
    stop: Positive | None = Field(
        None, description="time until which the obstacle exists [s]; to the end if absent"
    )
    response: Literal["reflect", "penalty", "exchange", "barrier"] = Field(
        "reflect",
        description="contact response: reflect, penalty and exchange (the paper's) keep nodes out; "
        "barrier keeps the whole surface out, with the keys of [self_contact]",
    )
    restitution: float | None = Field(
        None,
        ge=0,
        le=1,
        description='restitution of nodes that strike, with response = "reflect" or "exchange": '
        "normal speed after over before; 1 if absent [-]",
    )
    stiffness: Positive | None = Field(
        None,
        description='force on a node over its depth, with response = "penalty" [N/m]; 10 times '
        "the stiffest spring if absent",
    )
    friction: NotNegative | None = Field(
        None, description='Coulomb friction coefficient, with response = "penalty"; 0 if absent [-]'
    )
    friction_speed: Positive | None = Field(
        None, description=f'with response = "penalty", {FRICTION_SPEED}'
    )

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
            "stop": NODE_RESPONSES,
            "center": ("sphere", "barrier"),
        }
        if self.response == BARRIER and (self.shape not in BARRIER_SHAPES or self.start):
            shapes = " and ".join(BARRIER_SHAPES)
            raise rule(
                f'has response = "barrier", which is for {shapes} that are there from the start'
            )
        turns = any(any(pose.turn) for pose in self.path)
        if turns and (self.response != BARRIER or self.center is None):
            raise rule('has a path that turns, which is for response = "barrier" with a center')
        for name, use in uses.items():
            if getattr(self, name) is not None and not {self.shape, self.response} & set(use):
                raise rule(f"has {name}, which is for {' or '.join(map(repr, use))} only")
        return self


class SelfContactTable(Table):
    """Contact that keeps the surfaces of all bodies from crossing themselves and each other."""

    distance: Positive | None = Field(
        None,
        description="distance at which surface parts start to repel each other [m]; if absent the "
        "greatest of 3e-4 of the rest bounding box's diagonal, the median distance of a coarser "
        "surface from the body's own, and the lesser of 1/24 of a cell and the least gap at rest",
    )
    friction: NotNegative = Field(0.0, description="Coulomb friction coefficient [-]")
    friction_speed: Positive | None = Field(None, description=FRICTION_SPEED)
    surface: int | None = Field(
        None,
        ge=4,
        lt=2**63,
        description="triangles of a coarser surface used for contact [-]; the surface itself if "
        "absent",
    )
