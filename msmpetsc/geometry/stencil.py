"""How a point in a cell follows the nodes around it: one interface to the embeddings (paper 3.1)."""

import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.geometry.affine import affine_weights
from msmpetsc.geometry.block import ITSELF
from msmpetsc.geometry.cages_mvc import cages_weights
from msmpetsc.geometry.mvc import mvc_weights

KINDS = ("mvc", "cages", "affine")
ROUNDING = 1e-9  # how far outside its cell a point may be computed to lie
ON_FACE = 1e-14  # nearer than this to a face of its cell, a point is on it


def stencil_weights(kind: str, u: np.ndarray, neighbours: np.ndarray, smoothing: float = 1.0) -> np.ndarray:
    """Weights (p,64) of the nodes around points in valid cells; lengths in units of the cell size.

    u          : (p,3) coordinates in the cell, in [0,1]
    neighbours : (p,27) bool; column (dx+1)*9 + (dy+1)*3 + (dz+1): the cell at that offset is valid. 13 is the cell
    smoothing  : h of Eq. 9, in (0,1]; used by "cages"
    result     : column ix*16 + iy*4 + iz: the node at offset (ix-1, iy-1, iz-1) from the cell's low corner

    kind "mvc": mean value coordinates in the cell, continuous (Eq. 1-6); "cages": smooth blends of the coordinates in
    joined cells (Eq. 7-9); "affine": smooth blends of affine maps, the most accurate. A row sums to 1, reproduces
    linear fields and is exactly 0 at nodes of no valid cell. Nothing but the result grows with p.
    Raises InputError for an unknown kind or smoothing, ValueError for points outside their cell or cells not valid.
    """
    if kind not in KINDS:
        raise InputError(f"embedding '{kind}' is not one of {', '.join(KINDS)}")
    if not 0.0 < smoothing <= 1.0:
        raise InputError(f"smoothing of the embedding is {smoothing:g}: it lies in (0, 1]")
    if not np.all((u >= -ROUNDING) & (u <= 1.0 + ROUNDING)):
        raise ValueError("a point lies outside its cell")
    if not np.all(neighbours[:, ITSELF]):
        raise ValueError("a point lies in a cell that is not valid")
    u = np.ascontiguousarray(np.where(u < ON_FACE, 0.0, np.where(u > 1.0 - ON_FACE, 1.0, u)))
    neighbours = np.ascontiguousarray(neighbours, bool)  # one memory layout: the kernels are compiled once
    weights = np.empty((len(u), 64))
    if kind == "mvc":
        mvc_weights(u, weights)
    elif kind == "cages":
        cages_weights(u, neighbours, smoothing, weights)
    else:
        affine_weights(u, neighbours, weights)
    return weights
