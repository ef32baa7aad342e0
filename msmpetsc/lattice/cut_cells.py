"""Lumped mass and spring stiffness of a cell that the surface cuts.

The share of a corner (geometry.fill_fractions) is 8 times the integral of its trilinear function
over the part of the cell inside the surface. A spring's share of its stiffness in a whole cell is

    an edge:            the integral of its bilinear function, the mean share of its two ends;
    a face diagonal:    the integral of its face's linear function, the mean share of 4 corners;
    a space diagonal:   the volume inside, the mean share of all 8 corners.

A corner's mass is proportional to the diagonal of L that its springs give (README: boundary cells).
"""

import numpy as np

from msmpetsc.backend.arrays import Rows
from msmpetsc.lattice.material import CELLS_AROUND, ISOTROPIC

# corners of a cell [cell]; in VTK's hexahedron order, as in the result file
CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
)
# kind (8, 8) of the spring between two corners [-]; 0 on the diagonal
PAIR_KIND = ((CORNERS[:, None] - CORNERS) ** 2).sum(axis=2)
# whether a corner's share counts for a spring (8, 8, 8) [-]; it must agree with both
# ends in all coordinates in which the ends agree
COUNTED = (
    (CORNERS[:, None, None] == CORNERS) | (CORNERS[:, None, None] != CORNERS[None, :, None])
).all(axis=3)
# weight (8, 8, 8) of each corner's share in a spring's share [-]
MEAN = COUNTED / COUNTED.sum(axis=2, keepdims=True)
# stiffness (8, 8) of a cell's springs, relative to an edge inside a body [-]
STRENGTH = np.where(
    PAIR_KIND > 0, ISOTROPIC[PAIR_KIND] / np.maximum(CELLS_AROUND[PAIR_KIND], 1), 0.0
)


def shares_of_pairs(share: Rows) -> Rows:
    """Return the share (c, 8, 8) of each spring's stiffness, from the corners' shares (c, 8)."""
    of_pairs: Rows = np.einsum("cv,abv->cab", share, MEAN, optimize=True)
    return of_pairs


def shares_of_mass(of_pairs: Rows) -> Rows:
    """Return each corner's mass (c, 8) over 1/8 of a whole cell's, from ``shares_of_pairs``."""
    of_mass: Rows = np.einsum("cab,ab->ca", of_pairs, STRENGTH, optimize=True) / STRENGTH.sum(
        axis=1
    )
    return of_mass
