"""Material constants: Lame's constants, or the spring stiffnesses of an isotropic cubic lattice.

Central forces between the corners of cubes give Poisson's ratio 1/4 for any stiffness.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Rows

# The kind of a spring is its squared length in cells: 1 for an edge, 2 for a face
# diagonal, 3 for a space diagonal.

# cells that share a spring of each kind inside a body [-]
CELLS_AROUND = np.array([0, 4, 2, 1])
# stiffness of each kind relative to an edge [-]; 40 : 16 : 9 is isotropic up to the
# sixth moment of the directions, with E = 7/4 k1 / h
ISOTROPIC = np.array([0, 40, 16, 9]) / 40
# recommended time steps per vibration period [-]; enough to show the motion
STEPS_A_PERIOD = 40


class MixedCells(NamedTuple):
    """Cells of several materials (lattice.cell_materials).

    rows    : (k,) numbers of the cells
    fills   : (k, 8) fills of their corners (geometry.fill_fractions), weighted by stiffness
    moments : (k, 3) second moments of their stiffness
    """

    rows: Indices
    fills: Rows
    moments: Rows


@dataclass(frozen=True)
class CellMaterial:
    """Material constants of cells.

    density : (c,) [kg/m^3]
    spring  : (c,) Young's modulus [Pa], or else the stiffness of a spring [N/m]
    poisson : (c,) Poisson's ratio [-], unused by springs
    mixed   : cells of several stiffnesses; None if there are none
    """

    density: Floats
    spring: Floats
    poisson: Floats
    mixed: MixedCells | None = None


# material of the cells with these keys (c,)
MaterialOfCells = Callable[[Indices], CellMaterial]


def lame_constants(young_modulus: Floats, poisson: Floats) -> tuple[Floats, Floats]:
    """Return Lame's constants mu and lambda [Pa]; Poisson's ratio must be below 1/2."""
    shear = young_modulus / (2 * (1 + poisson))
    return shear, 2 * shear * poisson / (1 - 2 * poisson)


def edge_stiffness(young_modulus: Floats, cell_size: float) -> Floats:
    """Return the stiffness k1 [N/m] of an edge inside a body of Young's modulus E [Pa]."""
    return 4 / 7 * young_modulus * cell_size


def bending_period(length: float, thick: float, young_modulus: float, density: float) -> float:
    """Return the period [s] of the first bending mode of a bar clamped at one end.

    length : of the bar [m]
    thick  : thickness in the direction of bending [m]
    """
    return 2 * math.pi * length**2 / (3.516 * thick) * math.sqrt(12 * density / young_modulus)
