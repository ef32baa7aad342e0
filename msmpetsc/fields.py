"""The table of all datasets of a result file: type, shape, unit and meaning.

The writer, the reader's checks, xarray's names, study columns and the documentation use it.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, NamedTuple, get_type_hints

import numpy as np

from msmpetsc.backend.arrays import Floats, Positions, Rows


class Field(NamedTuple):
    """A dataset of a result file.

    dtype     : numpy name of the type written; a reader accepts any size of this kind
    shape     : length of each axis, a number or a letter; a letter has the same value in all
                datasets of a file (scripts/docs/pages/reference/result-file.md)
    unit      : "1" for a dimensionless quantity
    long_name : meaning in a few words
    at_rest   : name of the dataset with the values at rest, "" if there is none
    """

    dtype: str
    shape: tuple[int | str, ...]
    unit: str
    long_name: str
    at_rest: str = ""


def _number(dtype: str, unit: str, long_name: str) -> Field:
    """Return a field with a number in each frame."""
    return Field(dtype, ("T",), unit, long_name)


def _of_nodes(unit: str, long_name: str) -> Field:
    """Return a node field: the volume-weighted mean of a cell field over a node's cells."""
    return Field("f4", ("T", "n"), unit, long_name)


def _of_cells(unit: str, long_name: str) -> Field:
    """Return a field with a number for each cell."""
    return Field("f4", ("T", "c"), unit, long_name)


@dataclass(frozen=True)
class Frame:
    """The state of a run at a simulated time.

    Arrays hold this rank's rows; numbers are of all bodies. Errors are maxima and counts are sums
    over the steps since the previous stored frame.

    Attributes
    ----------
    index : int
        Number of the step, 0 for the start.
    time : float
        Simulated time [s].
    position : array
        Node positions (n_local, 3) [m].
    surface : array or None
        Surface points (v_local, 3) [m]; None if the scene does not store the surface.
    iterations : int
        Iterations of the nonlinear solver (SNES), or explicit substeps.

    ``FRAME_FIELDS`` has shape, unit and meaning of all attributes except ``index``. From
    ``reaction`` on, an attribute is None if the scene does not store it.
    """

    index: int
    time: Annotated[float, _number("f8", "s", "simulated time")]
    position: Annotated[
        Positions, Field("f8", ("T", "n", 3), "m", "node positions", "lattice/nodes")
    ]
    surface: Annotated[
        Positions | None, Field("f8", ("T", "v", 3), "m", "surface points", "surface/points")
    ] = None
    step_error: Annotated[float, _number("f8", "1", "estimated relative error of a step")] = 0.0
    iterations: Annotated[int, _number("i8", "1", "outer iterations")] = 0
    ksp_its: Annotated[int, _number("i8", "1", "iterations of the linear solver")] = 0
    kinetic: Annotated[float, _number("f8", "J", "kinetic energy")] = 0.0
    elastic: Annotated[float, _number("f8", "J", "elastic energy")] = 0.0
    potential: Annotated[float, _number("f8", "J", "energy in gravity and forces")] = 0.0
    contact: Annotated[float, _number("f8", "J", "contact energy of obstacles")] = 0.0
    momentum: Annotated[Floats, Field("f8", ("T", 3), "kg m/s", "momentum")] = field(
        default_factory=lambda: np.zeros(3)
    )
    wall_time: Annotated[float, _number("f8", "s", "computing time")] = 0.0
    true_error: Annotated[
        float, _number("f8", "1", "true relative error of a step, in position")
    ] = math.nan
    energy_error: Annotated[
        float, _number("f8", "1", "true relative error of a step, in energy")
    ] = math.nan
    inverted: Annotated[int, _number("i8", "1", "inverted cells")] = 0
    products: Annotated[
        int,
        _number("i8", "1", "Hessian-vector products, those of multigrid's finest level included"),
    ] = 0
    proof_products: Annotated[
        int, _number("i8", "1", "products that estimate errors or search for saddles")
    ] = 0
    substeps: Annotated[int, _number("i8", "1", "shorter steps taken in place of whole steps")] = 0
    fallbacks: Annotated[int, _number("i8", "1", "steps solved by the robust method")] = 0
    energy_gained: Annotated[float, _number("f8", "J", "energy gained without work")] = 0.0
    steps: Annotated[int, _number("i8", "1", "time steps taken")] = 0
    time_error: Annotated[
        float, _number("f8", "1", "estimated relative error of the motion so far")
    ] = math.nan
    self_contacts: Annotated[int, _number("i8", "1", "contacts of the surface with itself")] = 0
    self_distance: Annotated[
        float, _number("f8", "m", "least distance in a contact of the surface with itself")
    ] = math.nan
    self_contact: Annotated[
        float, _number("f8", "J", "contact energy of the surface with itself")
    ] = 0.0
    load: Annotated[Floats, Field("f8", ("T", 3), "N", "gravity and forces on all bodies")] = field(
        default_factory=lambda: np.zeros(3)
    )
    reaction: Annotated[
        Rows | None, Field("f8", ("T", "a", 3), "N", "force of a pin or anchor")
    ] = None
    torque: Annotated[
        Rows | None, Field("f8", ("T", "a", 3), "N m", "torque of a pin or anchor")
    ] = None
    push: Annotated[
        Rows | None,
        Field("f8", ("T", "o", 3), "N", "contact force of an obstacle, without impulses"),
    ] = None
    contact_push: Annotated[
        Rows | None, Field("f8", ("T", "b", 3), "N", "contact force of surfaces on a body")
    ] = None
    surface_load: Annotated[
        Rows | None, Field("f8", ("T", "l", 3), "N", "force of a traction or pressure")
    ] = None
    probe: Annotated[Rows | None, Field("f8", ("T", "w", 3), "m", "position of a probe")] = None
    stress: Annotated[
        Rows | None, Field("f4", ("T", "n", 6), "Pa", "Cauchy stress: xx, yy, zz, xy, yz, xz")
    ] = None
    von_mises: Annotated[Floats | None, _of_nodes("Pa", "von Mises stress of /frames/stress")] = (
        None
    )
    pressure: Annotated[Floats | None, _of_nodes("Pa", "pressure")] = None
    strain_energy: Annotated[
        Floats | None, _of_nodes("J/m^3", "elastic energy per volume at rest")
    ] = None
    cell_stress: Annotated[
        Rows | None, Field("f4", ("T", "c", 6), "Pa", "Cauchy stress of a cell")
    ] = None
    cell_von_mises: Annotated[Floats | None, _of_cells("Pa", "von Mises stress of a cell")] = None
    cell_pressure: Annotated[Floats | None, _of_cells("Pa", "pressure of a cell")] = None
    cell_strain_energy: Annotated[
        Floats | None, _of_cells("J/m^3", "elastic energy of a cell per volume at rest")
    ] = None

    def with_own_positions(self) -> "Frame":
        """Return the frame with a copy of the positions, so that its receiver may change them."""
        return replace(self, position=self.position.copy())

    def __repr__(self) -> str:
        """Return step, time and solver figures in a line, without the arrays."""
        solved = f"its {self.ksp_its}, error {self.step_error:.1e}"
        return (
            f"Frame({self.index}: t = {self.time:.6g} s, {solved}, position {self.position.shape})"
        )


FRAME_FIELDS: dict[str, Field] = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(Frame, include_extras=True).items()
    if hasattr(hint, "__metadata__")
}
STRESS = tuple(
    name
    for name in FRAME_FIELDS
    if name.endswith(("stress", "von_mises", "pressure", "strain_energy"))
)
# HDF5 dimension scale of each letter or length in a frame's shape. No scale is named
# like a field with several axes, which netCDF readers would take for coordinates.
DIMENSIONS: dict[int | str, str] = {
    "T": "time", "n": "node", "v": "point", "c": "cell", "a": "holder", "o": "obstacle",
    "b": "body", "l": "surface_load_number", "w": "probe_number", 3: "axis", 6: "component",
}  # fmt: skip
LABELS = {"axis": ("x", "y", "z"), "component": ("xx", "yy", "zz", "xy", "yz", "xz")}
# letters of dimensions that are distributed over ranks
RANKS_SHARE = {"n", "v", "c"}
LATTICE = {
    "nodes": Field("f8", ("n", 3), "m", "node positions at rest"),
    "cells": Field("i8", ("c", 8), "1", "corner nodes in VTK's order"),
    "cell_kind": Field("u1", ("c",), "1", "1 boundary, 2 interior"),
    "cell_share": Field("f8", ("c",), "1", "fraction of a cell that has mass and stiffness"),
    "springs": Field("i8", ("s", 2), "1", "nodes that a spring joins"),
    "rest_length": Field("f8", ("s",), "m", "rest length of a spring"),
    "stiffness": Field("f8", ("s",), "N/m", "stiffness of a spring"),
    "mass": Field("f8", ("n",), "kg", "mass of a node"),
    "pinned": Field("i8", ("p",), "1", "pinned nodes, without nodes of anchors"),
    "body": Field("i4", ("n",), "1", "number of a node's body, where there are several"),
}
SURFACE = {
    "points": Field("f8", ("v", 3), "m", "surface points at rest"),
    "triangles": Field("i8", ("f", 3), "1", "corner points of a triangle"),
    "body": Field("i4", ("v",), "1", "number of a point's body, where there are several"),
}
# surfaces of mesh and function obstacles, which a scene gives by a file or a name only
OBSTACLE = {
    "points": Field("f8", ("m", 3), "m", "points of obstacles' surfaces at time 0"),
    "triangles": Field("i8", ("h", 3), "1", "corner points of a triangle of an obstacle"),
    "number": Field("i4", ("h",), "1", "number of a triangle's obstacle in the scene"),
}
# W (v, n) in CSR form: surface points = W @ node positions
EMBEDDING = {
    "indptr": Field("i8", ("r",), "1", "where a point's weights begin"),
    "indices": Field("i8", ("e",), "1", "node of a weight"),
    "weights": Field("f8", ("e",), "1", "weight of a node for a surface point"),
}
# two slots; the slot with the greater step is valid
CHECKPOINT = {
    "step": Field("i8", (2,), "1", "number of the step, -1 for none, -2 - n at the end"),
    "numbers": Field("f8", (2, "k"), "1", "scalars that a step depends on; names in an attribute"),
    "q": Field("f8", (2, "n", 3), "m", "node positions"),
    "q_previous": Field("f8", (2, "n", 3), "m", "node positions one step before"),
    "history_q": Field("f8", (2, "n", 3), "m", "node positions in the history of BDF2"),
    "history_v": Field("f8", (2, "n", 3), "m/s", "node velocities in the history of BDF2"),
    "lowest_mode": Field("f8", (2, "n", 3), "kg^-1/2", "mode of least curvature"),
    "sides": Field("f8", (2, "n", "o"), "1", "side of a thin obstacle on which a node is"),
}
GROUPS = {
    "lattice": LATTICE,
    "surface": SURFACE,
    "obstacle": OBSTACLE,
    "embedding": EMBEDDING,
    "frames": FRAME_FIELDS,
    "checkpoint": CHECKPOINT,
}
FIELDS = {
    f"{group}/{name}": field for group, fields in GROUPS.items() for name, field in fields.items()
}


def unit_of(name: str) -> str:
    """Return the unit of a dataset such as "frames/time"; "1" for an unknown dataset."""
    return FIELDS[name].unit if name in FIELDS else "1"
