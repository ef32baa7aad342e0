"""Strain within a cut cell: its mean over the part inside the surface, and four hourglass modes.

Lengths are in cells, and the origin is the cell's centre. Corner a is at s / 2, with s_x, s_y and
s_z equal to -1 or 1. The corner values u_a have the seven sums

    X = sum s_x u,  Y,  Z,  XY = sum s_x s_y u,  XZ,  YZ,  XYZ = sum s_x s_y s_z u,

and the trilinear u within the cell has the slope

    du/dx = 1/4 (X + 2 y XY + 2 z XZ + 4 y z XYZ).

c is the centroid of the part inside the surface, C its covariance and <> the mean over it. The mean
slope is exactly

    4 <du/dx> = X + 2 c_y XY + 2 c_z XZ + 4 <y z> XYZ.

The modes are h_xy = XY + 2 c_z XYZ, h_xz, h_yz and XYZ. They give the rest of the slope:

    4 (du/dx - <du/dx>) = 2 (y - c_y) h_xy + 2 (z - c_z) h_xz + 4 ((y - c_y) (z - c_z) - C_yz) XYZ.

Its mean square, summed over x, y and z, is approximated by a quadratic form of the modes. Third
moments are neglected, and fourth moments are those of independent coordinates. The form is exact in
a whole cell (Flanagan and Belytschko 1981; Belytschko and Bindeman 1993). 16 times the form is

    4 (C_xx + C_yy) h_xy^2 + 8 C_yz h_xy h_xz + ... + 16 (C_xx C_yy + C_xx C_zz + C_yy C_zz) XYZ^2.

It is positive semidefinite because C is: it consists of three forms like
(h_xy, h_xz) [C_yy C_yz; C_yz C_zz] (h_xy, h_xz)^T, and a multiple of XYZ^2.
"""

import numpy as np

from msmpetsc.backend.arrays import Floats, Rows
from msmpetsc.geometry.grid import CORNERS

# columns of ``forms_of`` [-]
FORM = 13
# s (8, 3) of the corners [-]
SIGNS = 2.0 * CORNERS - 1
# axes of XY, XZ and YZ [-]
PAIRS = ((0, 1), (0, 2), (1, 2))
# coefficients (7, 8) of the seven sums [-]
SUMS = np.stack([*SIGNS.T, *(SIGNS[:, i] * SIGNS[:, j] for i, j in PAIRS), SIGNS.prod(axis=1)])
# row of ``forms_of`` for a whole cell [-]; its variances are 1/12
WHOLE = np.array([*[0.0] * 6, *[1 / 3] * 3, *[0.0] * 3, 1 / 3])


def forms_of(fills: Rows, moments: Rows) -> Rows:
    """Return the strain form (c, FORM) of cells: constants of the mean slopes and of the modes.

    The columns are

        2 c_x, 2 c_y, 2 c_z,
        4 <x y>, 4 <x z>, 4 <y z>,
        4 C_xx, 4 C_yy, 4 C_zz,
        4 C_yz, 4 C_xz, 4 C_xy,
        16 (C_xx C_yy + C_xx C_zz + C_yy C_zz)                the mode XYZ

    fills   : (c, 8) fills of the corners (geometry.fill_fractions)
    moments : (c, 3) integrals of x^2, y^2 and z^2 over the part inside (geometry.fill_fractions)
    """
    volume = fills.mean(axis=1, keepdims=True)
    middle, products = (
        fills @ sums.T / (8 * size * volume) for sums, size in ((SUMS[:3], 2), (SUMS[3:6], 4))
    )
    covariance = np.zeros((len(fills), 3, 3))
    for k in range(3):
        covariance[:, k, k] = moments[:, k] / volume[:, 0] - middle[:, k] ** 2
    for k, (i, j) in enumerate(PAIRS):
        covariance[:, i, j] = covariance[:, j, i] = products[:, k] - middle[:, i] * middle[:, j]
    # where parts of a body overlap, fills are clipped to 1: the covariance may then be
    # indefinite
    values, vectors = np.linalg.eigh(covariance)
    covariance = (vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.transpose(0, 2, 1)
    x, y, z = covariance[:, range(3), range(3)].T
    coupled = 4 * np.stack([covariance[:, 1, 2], covariance[:, 0, 2], covariance[:, 0, 1]], axis=1)
    own = 4 * np.stack([x, y, z], axis=1)
    return np.concatenate(
        [2 * middle, 4 * products, own, coupled, 16 * (x * y + x * z + y * z)[:, None]], axis=1
    )


def slopes_and_modes(forms: Rows) -> tuple[Rows, Rows]:
    """Return the operators from corner values to 4 times the mean slopes, and to the modes.

    The operators are (c, 3, 8) and (c, 4, 8); lengths are in cells.
    """
    cx, cy, cz = forms[:, :3].T[:, :, None]
    xy, xz, yz = forms[:, 3:6].T[:, :, None]
    x, y, z, of_xy, of_xz, of_yz, of_xyz = SUMS
    slopes = (
        x + (cy * of_xy + cz * of_xz + yz * of_xyz),
        y + (cx * of_xy + cz * of_yz + xz * of_xyz),
        z + (cx * of_xz + cy * of_yz + xy * of_xyz),
    )
    modes = of_xy + cz * of_xyz, of_xz + cy * of_xyz, of_yz + cx * of_xyz, of_xyz + 0 * cx
    return np.stack(slopes, axis=1), np.stack(modes, axis=1)


def laplacians(forms: Rows, volume: Floats) -> Rows:
    """Return the stiffness matrices (c, 8, 8) of the Laplacian on cut cells, in units of cells.

    The entries are the integrals of grad N_a . grad N_b over the part inside the surface.

    volume : (c,) fraction of each cell that lies inside [-]
    """
    return _with_form(forms, volume, _modes_form(forms))


def bounding_laplacians(forms: Rows, volume: Floats) -> Rows:
    """Return matrices (c, 8, 8), no less than ``laplacians``, that bound a solid's Hessian at rest.

    In the module's notation, the energy of elasticity.assumed_strain at rest is, for component x,
    at most (2 mu + 3 lambda) / 16 times

        4 <(d_y h_xy + d_z h_xz)^2> + 4 (C_yy + C_zz) h_yz^2 + 16 (...) XYZ^2,

    and likewise for y and z. If coordinates are correlated, the form of |grad u|^2 may be less than
    this form'. Then the diagonal D of the form is added to it, times the greatest eigenvalue of
    D^(-1/2) (form' - form) D^(-1/2) if that is positive.
    """
    form = _modes_form(forms)
    diagonal = np.diagonal(form, axis1=1, axis2=2)[:, :3]
    scale = 1 / np.sqrt(np.maximum(diagonal, np.finfo(float).tiny))
    lack = np.zeros(len(forms))
    own = forms[:, 6:9]
    for axis in range(3):
        # the two modes that bend along the axis, and the mode that twists
        bends = [k for k, pair in enumerate(PAIRS) if axis in pair]
        others = [sum(PAIRS[k]) - axis for k in bends]
        twist = 3 - sum(bends)
        of_axis = np.zeros((len(forms), 3, 3))
        for k, other in zip(bends, others, strict=True):
            of_axis[:, k, k] = own[:, other]
        i, j = bends
        of_axis[:, i, j] = of_axis[:, j, i] = form[:, i, j]
        of_axis[:, twist, twist] = own[:, others].sum(axis=1)
        missing = (of_axis - form[:, :3, :3]) * scale[:, :, None] * scale[:, None, :]
        lack = np.maximum(lack, np.linalg.eigvalsh(missing)[:, -1])
    for k in range(3):
        form[:, k, k] += lack * diagonal[:, k]
    return _with_form(forms, volume, form)


def _modes_form(forms: Rows) -> Rows:
    """Return the quadratic form (c, 4, 4) of the modes: 16 times the mean square of the slopes."""
    x, y, z = forms[:, 6:9].T
    form = np.zeros((len(forms), 4, 4))
    for k, own in enumerate((x + y, x + z, y + z)):
        form[:, k, k] = own
    for k, (i, j) in enumerate(PAIRS):
        form[:, i, j] = form[:, j, i] = forms[:, 9 + k]
    form[:, 3, 3] = forms[:, 12]
    return form


def _with_form(forms: Rows, volume: Floats, form: Rows) -> Rows:
    slopes, modes = slopes_and_modes(forms)
    both = slopes.transpose(0, 2, 1) @ slopes + modes.transpose(0, 2, 1) @ form @ modes
    integrals: Rows = volume[:, None, None] / 16 * both
    return integrals
