"""Tables of what the body is: surface, cells, material, parts, and regions of it."""

from typing import Annotated, Any, Final, Literal, Self, get_args

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from msmpetsc.scene.problems import rule, unknown_name
from msmpetsc.scene.values import (
    Box,
    Count,
    Direction,
    FileName,
    GroupName,
    ListOf,
    NotNegative,
    Painted,
    Positive,
    Table,
    UnitVector,
    Vector,
    only_for,
)

SOLID: Final = "neo-hookean"

PoissonRatio = Annotated[float, Field(ge=0, le=0.4999)]


class Rotate(Table):
    """A turn about the origin."""

    axis: Direction = Field(description="axis of the turn, of any length but zero [-]")
    degrees: float = Field(description="angle, right-handed about the axis [degrees]")


class StepTable(Table):
    """A step of mesh preparation that needs a value."""

    one_of = ("simplify", "refine", "rotate")
    simplify: int | None = Field(None, ge=4, lt=2**63, description="triangles to keep [-]")
    refine: float | None = Field(
        None, ge=1e-3, le=1, description="longest edge, of the body's longest side [-]"
    )
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


PrepareStep = Annotated[str | dict[str, Any], BeforeValidator(_step)]


class MeshTable(Table):
    """The closed surface."""

    source: FileName = Field(description="registry name, or path beside or below this file")
    prepare: ListOf[PrepareStep] = Field(
        (),
        description="steps in this order: merge, largest_part, union, repair, orient, "
        "{ simplify = triangles [-] }, { refine = longest edge, of the longest side [-] }, "
        "{ rotate = { axis = [x, y, z] [-], degrees = angle [degrees] } }",
    )
    size: Positive | None = Field(
        None, description="longest side of the bounding box [m]; as in the file if absent"
    )
    base: Vector | None = Field(
        None, description="where the middle of the bounding box's bottom face stands [m]"
    )


class CagesTable(Table):
    """The grid cells that fill the surface, and how the surface follows them."""

    one_of = ("count", "cell_size")
    count: Count | None = Field(None, description="number of valid cells aimed at [-]")
    cell_size: Positive | None = Field(None, description="edge of a cell [m]")
    boundary: Literal["fill", "whole"] = Field(
        "fill",
        description="boundary cells weigh and resist by the share of them that is inside, or whole, as the paper's",
    )
    embedding: Literal["affine", "cages", "mvc"] = Field(
        "affine", description="how the surface follows the nodes"
    )
    smoothing: float = Field(
        1.0, gt=0, le=1, description='width h of f_h in Eq. 9, with embedding = "cages" [cells]'
    )
    max_cells: Count = Field(5_000_000, description="refuse a lattice of more cells than this [-]")

    _has_a_use = field_validator("smoothing")(only_for("embedding", "cages"))


class Material(Table):
    """Material of the lattice."""

    one_of = ("young_modulus", "stiffness")
    young_modulus: Positive | None = Field(None, description="Young's modulus [Pa]")
    stiffness: Positive | None = Field(
        None, description="the same stiffness for every spring [N/m]"
    )
    density: Positive = Field(description="mass density [kg/m^3]")
    law: Literal["neo-hookean", "linear"] = Field(
        SOLID, description="neo-hookean: a solid; linear: springs, whose Poisson's ratio is 1/4"
    )
    poisson_ratio: PoissonRatio = Field(
        0.25, description='of law = "neo-hookean"; tissue has 0.45 to 0.49 [-]'
    )
    damping: NotNegative = Field(
        0.0,
        description="of velocities, by the mass: what nothing else moves slows down as exp(-damping t) [1/s]",
    )
    retardation_time: NotNegative = Field(
        0.0,
        description='of law = "neo-hookean": its viscosity over its stiffness, as of Kelvin and Voigt\'s solid [s]',
    )

    _is_of_solids = field_validator("poisson_ratio", "retardation_time")(
        only_for("law", "neo-hookean")
    )

    @model_validator(mode="after")
    def _solids_have_no_springs(self) -> Self:
        if self.law == SOLID and self.stiffness is not None:
            raise rule(
                'has stiffness, which is of springs: give law = "linear", or young_modulus in its place',
                "stiffness",
            )
        return self

    @property
    def poisson(self) -> float | None:
        """Return Poisson's ratio of a solid; None of springs."""
        return self.poisson_ratio if self.law == SOLID else None

    @property
    def spring(self) -> float:
        """Return Young's modulus [Pa], or the stiffness [N/m] that is given in its place."""
        given = self.young_modulus or self.stiffness
        assert given is not None  # the schema has one of the two
        return given


class Sphere(Table):
    """A ball."""

    center: Vector = Field(description="[m], or [-] if relative")
    radius: Positive = Field(
        description="[m], or in longest sides of the rest bounding box [-] if relative"
    )


class HalfSpace(Table):
    """All that lies on one side of a plane."""

    point: Vector = Field(description="a point of the plane [m], or [-] if relative")
    normal: UnitVector = Field(
        description="towards the side that is meant, normalised on reading [-]"
    )


class Region(Table):
    """A part of space at rest: its nodes are meant, or of a part the cells with their middles in it."""

    one_of = ("box", "sphere", "half_space", "painted", "group")
    box: Box | None = Field(
        None,
        description="two corners, each coordinate of the first the lower [m], or [-] if relative",
    )
    sphere: Sphere | None = Field(None, description="a ball [m], or [-] if relative")
    half_space: HalfSpace | None = Field(
        None, description="one side of a plane [m], or [-] if relative"
    )
    painted: Painted | None = Field(
        None,
        description="numbers, from 0, of points of the prepared surface (/surface/points of the result), or a "
        "text file beside this file that lists them: the cells they lie in are meant, or their corners [-]",
    )
    group: GroupName | None = Field(
        None,
        description="name, or number, that the mesh gives to some of its surface or cells (msmpetsc inspect lists "
        "them): the nodes nearest to its triangles are meant, of a part the cells that these cut, and "
        "all that a closed group encloses [-]",
    )
    relative: bool = Field(
        False, description="coordinates run 0..1 along each axis of the rest bounding box"
    )

    @field_validator("relative")
    @classmethod
    def _has_a_use(cls, relative: bool, info: ValidationInfo) -> bool:
        for key, words in (("painted", "painted points"), ("group", "a group")):
            if relative and info.data.get(key) is not None:
                raise rule(f"has no meaning for {words}", key)
        return relative

    @property
    def is_of_mesh(self) -> bool:
        """Return whether it names points or triangles of the mesh, and no part of space."""
        return self.painted is not None or self.group is not None


class OwnMaterial(Table):
    """Material of a part; a key that is absent is that of the scene's material."""

    density: Positive | None = Field(
        None, description="mass density; the material's if absent [kg/m^3]"
    )
    young_modulus: Positive | None = Field(
        None, description="Young's modulus; the material's if absent [Pa]"
    )
    poisson_ratio: PoissonRatio | None = Field(
        None, description="Poisson's ratio; the material's if absent [-]"
    )
    stiffness: Positive | None = Field(
        None,
        description="of springs; one between cells of several parts has the mean of its cells' [N/m]",
    )

    @model_validator(mode="after")
    def _says_something(self) -> Self:
        if all(
            each is None
            for each in (self.density, self.young_modulus, self.poisson_ratio, self.stiffness)
        ):
            raise rule("needs density, young_modulus, poisson_ratio or stiffness")
        return self


class PartTable(OwnMaterial):
    """Cells of another material; of two parts with a cell, the last that gives a key counts."""

    region: Region = Field(description="the cells whose middles lie in it")
