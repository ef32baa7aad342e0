"""Constants of a law by its material: Lame's, or the stiffness of springs of a cubic lattice.

Central forces between the corners of cubes give Poisson's ratio 1/4 whatever the stiffness.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices

# a spring's kind is its squared length in cells: 1 of an edge, 2 of a face diagonal, 3 of a space diagonal
CELLS_AROUND = np.array([0, 4, 2, 1])  # cells that share a spring of each kind inside a body
# k1 : k2 : k3 = 40 : 16 : 9 is isotropic up to the sixth moment of the directions; then E = 7/4 k1 / h
ISOTROPIC = np.array([0, 40, 16, 9]) / 40
STEPS_A_PERIOD = 40  # that show a vibration well


@dataclass(frozen=True)
class CellMaterial:
    """What cells are made of.

    density : (c,) [kg/m^3]
    spring  : (c,) Young's modulus [Pa], or stiffness [N/m] where the material gives that
    poisson : (c,) Poisson's ratio [-], which springs have no use for
    """

    density: Floats
    spring: Floats
    poisson: Floats


MaterialOfCells = Callable[[Indices], CellMaterial]  # by the grid index (c, 3) of cells


def calibrated_stiffness(
    young_modulus: float | Floats, cell_size: float, kind: Indices, cells: Indices
) -> Floats:
    """Return the spring stiffness [N/m] of an isotropic lattice with Young's modulus E [Pa] at small strain.

    Assembled cell by cell, so a spring on the body's boundary has the weight of the cells it bounds.

    young_modulus : E; where cells differ, (s,) the mean of those that share a spring
    cell_size     : h [m]
    kind          : (s,) squared length in cells
    cells         : (s,) number of valid cells that share the spring
    """
    stiffness: Floats = (
        edge_stiffness(young_modulus, cell_size) * ISOTROPIC[kind] * cells / CELLS_AROUND[kind]
    )
    return stiffness


def lame_constants(young_modulus: Floats, poisson: Floats) -> tuple[Floats, Floats]:
    """Return mu and lambda [Pa] by Young's modulus [Pa] and Poisson's ratio, below 1/2."""
    shear = young_modulus / (2 * (1 + poisson))
    return shear, 2 * shear * poisson / (1 - 2 * poisson)


def edge_stiffness(young_modulus: float | Floats, cell_size: float) -> float | Floats:
    """Return k1 [N/m] of an edge inside a body of E [Pa], cells of h [m]."""
    return 4 / 7 * young_modulus * cell_size


def bending_period(length: float, thick: float, young_modulus: float, density: float) -> float:
    """Return the period [s] of the first bending mode of a bar clamped at one end.

    length, thick : of the bar, and across it where it bends [m]
    """
    return 2 * math.pi * length**2 / (3.516 * thick) * math.sqrt(12 * density / young_modulus)
