"""Lumped mass and spring stiffness of a cell that the surface cuts.

The fill of a corner (geometry.fill_fractions) is 8 times the integral of its trilinear function
over the part of the cell inside the surface. The stiffness of a spring, over its stiffness in a
whole cell, is

    an edge:            the integral of its bilinear function, the mean fill of its two ends;
    a face diagonal:    the integral of its face's linear function, the mean fill of 4 corners;
    a space diagonal:   the volume inside, the mean fill of all 8 corners.

A corner's mass is proportional to the diagonal of L that its springs give (README: boundary cells).
"""

import numpy as np

from msmpetsc.backend.arrays import Rows
from msmpetsc.geometry.grid import CORNERS
from msmpetsc.lattice.material import CELLS_AROUND, ISOTROPIC

# kind (8, 8) of the spring between two corners [-]; 0 on the diagonal
PAIR_KIND = ((CORNERS[:, None] - CORNERS) ** 2).sum(axis=2)
# whether a corner's fill counts for a spring (8, 8, 8) [-]; the corner must agree with
# both ends in the coordinates in which the ends agree
COUNTED = (
    (CORNERS[:, None, None] == CORNERS) | (CORNERS[:, None, None] != CORNERS[None, :, None])
).all(axis=3)
# weight (8, 8, 8) of each corner's fill in a spring's fraction [-]
MEAN = COUNTED / COUNTED.sum(axis=2, keepdims=True)
# stiffness (8, 8) of a cell's springs, relative to an edge inside a body [-]
STRENGTH = np.where(
    PAIR_KIND > 0, ISOTROPIC[PAIR_KIND] / np.maximum(CELLS_AROUND[PAIR_KIND], 1), 0.0
)


def spring_fractions(fills: Rows) -> Rows:
    """Return the fraction (c, 8, 8) of each spring's stiffness, from the corners' fills (c, 8)."""
    of_pairs: Rows = np.einsum("cv,abv->cab", fills, MEAN, optimize=True)
    return of_pairs


def mass_fractions(of_pairs: Rows) -> Rows:
    """Return each corner's mass (c, 8) over 1/8 of a whole cell's mass, by ``spring_fractions``."""
    of_mass: Rows = np.einsum("cab,ab->ca", of_pairs, STRENGTH, optimize=True) / STRENGTH.sum(
        axis=1
    )
    return of_mass
