"""Scene tables of a body: mesh, cages, material, parts, and regions."""

from typing import Annotated, Any, Final, Literal, Self, get_args

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from msmpetsc.scene.problems import rule
from msmpetsc.scene.values import (
    Box,
    Count,
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
    """A rotation about the origin."""

    axis: UnitVector = Field(description="rotation axis of any nonzero length [-]")
    degrees: float = Field(description="angle, right-handed about the axis [degrees]")


class StepTable(Table):
    """A mesh preparation step that has a value."""

    one_of = ("simplify", "refine", "rotate")
    simplify: int | None = Field(None, ge=4, lt=2**63, description="triangles to keep [-]")
    refine: float | None = Field(
        None, ge=1e-3, le=1, description="longest edge over the body's longest side [-]"
    )
    rotate: Rotate | None = Field(None, description="rotate the surface")


StepName = Literal["merge", "largest_part", "union", "repair", "orient"]


def _step(value: Any) -> str | dict[str, Any]:
    """Return a checked step: its name, or a dict with a single key."""
    if isinstance(value, dict):
        return StepTable.model_validate(value).model_dump(exclude_none=True)
    if not isinstance(value, str):
        raise rule("must be a step name or a table such as { simplify = 5000 }")
    if value in StepTable.one_of:
        raise rule(f"needs a value: {{ {value} = ... }}")
    if value not in get_args(StepName):
        raise rule(f"must be one of {', '.join(get_args(StepName))}")
    return value


PrepareStep = Annotated[str | dict[str, Any], BeforeValidator(_step)]


class MeshTable(Table):
    """The closed surface of a body."""

    source: FileName = Field(
        description="registry name, or path of a file in or below the scene's folder"
    )
    prepare: ListOf[PrepareStep] = Field(
        (),
        description="steps, done in the order given: merge, largest_part, union, repair, orient, "
        "{ simplify = triangles [-] }, { refine = longest edge over longest side [-] }, "
        "{ rotate = { axis = [x, y, z] [-], degrees = angle [degrees] } }",
    )
    size: Positive | None = Field(
        None, description="longest side of the bounding box [m]; as in the file if absent"
    )
    base: Vector | None = Field(
        None, description="centre of the bounding box's bottom face [m]; as in the file if absent"
    )


class CagesTable(Table):
    """The grid cells that fill the surface, and the embedding of the surface in them."""

    one_of = ("count", "cell_size")
    count: Count | None = Field(None, description="number of valid cells to aim at [-]")
    cell_size: Positive | None = Field(None, description="edge of a cell [m]")
    boundary: Literal["fill", "whole"] = Field(
        "fill",
        description="mass and stiffness of boundary cells: fill scales them by the fraction of the "
        "cell inside the surface; whole counts the full cell, as in the paper",
    )
    embedding: Literal["affine", "cages", "mvc"] = Field(
        "affine",
        description="interpolation of surface points from nodes: a smoothed affine map at each "
        "node, the paper's cages, or mean value coordinates",
    )
    smoothing: float = Field(
        1.0,
        gt=0,
        le=1,
        description='width h of f_h in Eq. 9 of the paper, with embedding = "cages" [cells]',
    )
    max_cells: Count = Field(5_000_000, description="refuse a lattice with more cells [-]")

    _has_a_use = field_validator("smoothing")(only_for("embedding", "cages"))


class Material(Table):
    """Material of the lattice."""

    one_of = ("young_modulus", "stiffness")
    young_modulus: Positive | None = Field(None, description="Young's modulus [Pa]")
    stiffness: Positive | None = Field(
        None, description='stiffness of every spring, with law = "linear" [N/m]'
    )
    density: Positive = Field(description="mass density [kg/m^3]")
    law: Literal["neo-hookean", "linear"] = Field(
        SOLID, description="neo-hookean: a solid; linear: springs with Poisson's ratio 1/4"
    )
    poisson_ratio: PoissonRatio = Field(
        0.25, description='Poisson\'s ratio, with law = "neo-hookean"; tissue has 0.45 to 0.49 [-]'
    )
    volume: Literal["quadratic", "log", "simo"] = Field(
        "quadratic",
        description='energy of the volume ratio J beside -mu ln J, with law = "neo-hookean": '
        "quadratic, lambda/2 (J - 1)^2; log, lambda/2 (ln J)^2; simo, lambda/4 (J^2 - 1 - 2 ln J)",
    )
    damping: NotNegative = Field(
        0.0, description="mass-proportional damping: free velocities decay as exp(-damping t) [1/s]"
    )
    retardation_time: NotNegative = Field(
        0.0,
        description="viscosity over stiffness of a Kelvin-Voigt solid, "
        'with law = "neo-hookean" [s]',
    )

    _is_of_solids = field_validator("poisson_ratio", "volume", "retardation_time")(
        only_for("law", "neo-hookean")
    )

    @model_validator(mode="after")
    def _solids_have_no_springs(self) -> Self:
        if self.law == SOLID and self.stiffness is not None:
            raise rule(
                'has stiffness, which is for springs: give law = "linear", or give young_modulus '
                "in place of stiffness"
            )
        return self

    @property
    def poisson(self) -> float | None:
        """Return Poisson's ratio of a solid; None for springs."""
        return self.poisson_ratio if self.law == SOLID else None

    @property
    def spring(self) -> float:
        """Return Young's modulus [Pa] if given, otherwise the spring stiffness [N/m]."""
        given = self.young_modulus or self.stiffness
        assert given is not None
        return given


class Sphere(Table):
    """A ball."""

    center: Vector = Field(description="centre [m], or [-] if relative")
    radius: Positive = Field(
        description="radius [m]; if relative, in longest sides of the rest bounding box [-]"
    )


class HalfSpace(Table):
    """A half-space bounded by a plane."""

    point: Vector = Field(description="a point of the plane [m], or [-] if relative")
    normal: UnitVector = Field(
        description="normal that points into the half-space, of any nonzero length [-]"
    )


class Region(Table):
    """A part of space or of the mesh: selects nodes at rest, or shares of cells for a part."""

    one_of = ("box", "sphere", "half_space", "painted", "group")
    box: Box | None = Field(
        None, description="two corners, the lower coordinates first [m], or [-] if relative"
    )
    sphere: Sphere | None = Field(None, description="a ball [m], or [-] if relative")
    half_space: HalfSpace | None = Field(None, description="a half-space [m], or [-] if relative")
    painted: Painted | None = Field(
        None,
        description="point numbers of the prepared surface, from 0 (/surface/points of the "
        "result), or a text file that lists them, in or below the scene's folder; selects the "
        "cells that contain these points, or the corners of these cells [-]",
    )
    group: GroupName | None = Field(
        None,
        description="name or number of a group in the mesh file (msmpetsc inspect lists groups); "
        "selects the nodes nearest to its triangles, or for a part of an open group the cells that "
        "these cut, and everything inside a closed group [-]",
    )
    relative: bool = Field(
        False, description="coordinates run from 0 to 1 along each side of the rest bounding box"
    )

    @field_validator("relative")
    @classmethod
    def _has_a_use(cls, relative: bool, info: ValidationInfo) -> bool:
        for key, selection in (("painted", "painted points"), ("group", "a group")):
            if relative and info.data.get(key) is not None:
                raise rule(f"has no meaning for {selection}")
        return relative

    @property
    def is_of_mesh(self) -> bool:
        """Return whether the region names points or triangles of the mesh."""
        return self.painted is not None or self.group is not None


class OwnMaterial(Table):
    """Material of a part or body; an absent key has the value of the scene's material."""

    density: Positive | None = Field(
        None, description="mass density; the scene's material.density if absent [kg/m^3]"
    )
    young_modulus: Positive | None = Field(
        None, description="Young's modulus; the scene's material.young_modulus if absent [Pa]"
    )
    poisson_ratio: PoissonRatio | None = Field(
        None, description="Poisson's ratio; the scene's material.poisson_ratio if absent [-]"
    )
    stiffness: Positive | None = Field(
        None,
        description="spring stiffness; the mean of adjacent cells where parts meet; the scene's "
        "material.stiffness if absent [N/m]",
    )

    @model_validator(mode="after")
    def _says_something(self) -> Self:
        if all(
            value is None
            for value in (self.density, self.young_modulus, self.poisson_ratio, self.stiffness)
        ):
            raise rule("needs density, young_modulus, poisson_ratio or stiffness")
        return self


class PartTable(OwnMaterial):
    """A region of another material. In an overlap the last part that gives a key counts."""

    region: Region = Field(
        description="place of the part; a cell that its edge cuts has the mean by volume"
    )
