"""Strain within a cell that the surface cuts: its mean, and the four modes that the mean does not see.

Corner a of a cell stands at s / 2 from its middle, s_x, s_y, s_z = -1 or 1, in cells. Of the corners' values u_a there
are the seven sums  X = sum s_x u,  Y,  Z,  XY = sum s_x s_y u,  XZ,  YZ,  XYZ, and of the trilinear u within the cell

    du/dx = 1/4 (X + 2 y XY + 2 z XZ + 4 y z XYZ).

With c the centroid of what is inside, C its covariance and <> a mean over it, the mean slope is, exactly,

    4 <du/dx> = X + 2 c_y XY + 2 c_z XZ + 4 <y z> XYZ,

and what is left is, with h_xy = XY + 2 c_z XYZ, h_xz and h_yz alike,

    4 (du/dx - <du/dx>) = 2 (y - c_y) h_xy + 2 (z - c_z) h_xz + 4 ((y - c_y) (z - c_z) - C_yz) XYZ.

The sum over x, y, z of its mean square is taken as a form of the modes, third moments left out and fourth ones as of
independent coordinates: exact in a whole cell (Flanagan and Belytschko 1981; Belytschko and Bindeman 1993),

    16 (...) = 4 (C_xx + C_yy) h_xy^2 + 8 C_yz h_xy h_xz + ... + 16 (C_xx C_yy + C_xx C_zz + C_yy C_zz) XYZ^2.

It is three sums like (h_xy, h_xz) [C_yy C_yz; C_yz C_zz] (h_xy, h_xz)^T, and so not negative, as a covariance is not.
"""

import numpy as np

from msmpetsc.backend.arrays import Floats, Rows
from msmpetsc.lattice.cut_cells import CORNERS

FORM = 13  # numbers of a cell's form: 2 c (3), 4 <xy>, <xz>, <yz>, then the modes' form of ``forms_of``
SIGNS = 2.0 * CORNERS - 1
PAIRS = ((0, 1), (0, 2), (1, 2))
SUMS = np.stack(
    [*SIGNS.T, *(SIGNS[:, i] * SIGNS[:, j] for i, j in PAIRS), SIGNS.prod(axis=1)]
)  # (7, 8) of the corners
WHOLE = np.array([*[0.0] * 6, *[2 / 3] * 3, *[0.0] * 3, 1 / 3])  # form of a whole cell


def forms_of(share: Rows, squares: Rows) -> Rows:
    """Return the forms (c, FORM) of cells by their corners' shares (c, 8) and their squares (c, 3) (fill_fractions).

    Columns: 2 c_x, 2 c_y, 2 c_z; 4 <xy>, 4 <xz>, 4 <yz>; 4 (C_xx + C_yy), 4 (C_xx + C_zz), 4 (C_yy + C_zz);
    4 C_yz, 4 C_xz, 4 C_xy, which couple the first mode with the second, the first with the third, and these two;
    16 (C_xx C_yy + C_xx C_zz + C_yy C_zz).
    """
    volume = share.mean(axis=1, keepdims=True)
    middle, products = (
        share @ sums.T / (8 * size * volume) for sums, size in ((SUMS[:3], 2), (SUMS[3:6], 4))
    )
    covariance = np.zeros((len(share), 3, 3))
    for k in range(3):
        covariance[:, k, k] = squares[:, k] / volume[:, 0] - middle[:, k] ** 2
    for k, (i, j) in enumerate(PAIRS):
        covariance[:, i, j] = covariance[:, j, i] = products[:, k] - middle[:, i] * middle[:, j]
    values, vectors = np.linalg.eigh(
        covariance
    )  # of bodies that overlap the shares are cut at 1: then it may be none
    covariance = (vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.transpose(0, 2, 1)
    x, y, z = covariance[:, range(3), range(3)].T
    coupled = 4 * np.stack([covariance[:, 1, 2], covariance[:, 0, 2], covariance[:, 0, 1]], axis=1)
    own = 4 * np.stack([x + y, x + z, y + z], axis=1)
    return np.concatenate(
        [2 * middle, 4 * products, own, coupled, 16 * (x * y + x * z + y * z)[:, None]], axis=1
    )


def slopes_and_modes(forms: Rows) -> tuple[Rows, Rows]:
    """Return, of corner values, 4 times the mean slopes (c, 3, 8) of cells in cell units, and their modes (c, 4, 8)."""
    (cx, cy, cz), (xy, xz, yz) = forms[:, :3].T[:, :, None], forms[:, 3:6].T[:, :, None]
    x, y, z, of_xy, of_xz, of_yz, of_xyz = SUMS
    slopes = (
        x + (cy * of_xy + cz * of_xz + yz * of_xyz),
        y + (cx * of_xy + cz * of_yz + xz * of_xyz),
        z + (cx * of_xz + cy * of_yz + xy * of_xyz),
    )
    modes = of_xy + cz * of_xyz, of_xz + cy * of_xyz, of_yz + cx * of_xyz, of_xyz + 0 * cx
    return np.stack(slopes, axis=1), np.stack(modes, axis=1)


def laplacians(forms: Rows, volume: Floats) -> Rows:
    """Return the integrals (c, 8, 8) of grad N_a . grad N_b over what is inside of cells, in cell units.

    volume : (c,) of what is inside, of a whole cell's
    """
    slopes, modes = slopes_and_modes(forms)
    form = np.zeros((len(forms), 4, 4))
    for k in range(3):
        form[:, k, k] = forms[:, 6 + k]
    for k, (i, j) in enumerate(PAIRS):
        form[:, i, j] = form[:, j, i] = forms[:, 9 + k]
    form[:, 3, 3] = forms[:, 12]
    both = slopes.transpose(0, 2, 1) @ slopes + modes.transpose(0, 2, 1) @ form @ modes
    integrals: Rows = volume[:, None, None] / 16 * both
    return integrals
