"""Mass and stiffness of a cell that the surface cuts.

Each corner has its share (geometry.fill_fractions), 8 times the integral of its trilinear function
over what is inside. Of a whole cell's spring there is then

    an edge:            the integral of its bilinear function, which is the mean share of its two ends;
    a face diagonal:    the integral of its face's linear function, the mean share of the face's four corners;
    a space diagonal:   the volume inside, the mean share of all eight.

Each corner's mass goes as the diagonal of L that its springs make: why, and what follows, the README tells.
"""

import numpy as np

from msmpetsc.backend.arrays import Rows
from msmpetsc.lattice.material import CELLS_AROUND, ISOTROPIC

# corners of a cell in VTK's hexahedron order, which is also the order in the file
CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
)
KIND = ((CORNERS[:, None] - CORNERS) ** 2).sum(
    axis=2
)  # (8, 8) of the spring between two corners; 0 of none
# (8, 8, 8): corners whose shares a spring has the mean of are those that agree with both ends where these agree
MEANT = (
    (CORNERS[:, None, None] == CORNERS) | (CORNERS[:, None, None] != CORNERS[None, :, None])
).all(axis=3)
MEAN = MEANT / MEANT.sum(axis=2, keepdims=True)
STRENGTH = np.where(
    KIND > 0, ISOTROPIC[KIND] / np.maximum(CELLS_AROUND[KIND], 1), 0.0
)  # (8, 8) of a cell's springs


def shares_of_pairs(share: Rows) -> Rows:
    """Return the shares (c, 8, 8) of a whole cell's springs, by their two ends, from those of corners (c, 8)."""
    of_pairs: Rows = np.einsum("cv,abv->cab", share, MEAN, optimize=True)
    return of_pairs


def shares_of_mass(of_pairs: Rows) -> Rows:
    """Return the share (c, 8) of an eighth of a whole cell's mass that each corner has, from the springs' (c, 8, 8)."""
    of_mass: Rows = np.einsum("cab,ab->ca", of_pairs, STRENGTH, optimize=True) / STRENGTH.sum(
        axis=1
    )
    return of_mass
