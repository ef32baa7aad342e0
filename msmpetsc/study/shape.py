"""The shape error: how far a body is from its rest shape, wherever it has gone."""

import warnings

import numpy as np
from scipy.spatial.transform import Rotation

from msmpetsc.output.reader import Result


def shape_error(run: Result, frame: int) -> float | None:
    """Of a frame of a result file, see ``distance_of_shapes``; None where a position is not finite."""
    position = run.frames.position[frame]
    if not np.isfinite(position).all():
        return None
    return distance_of_shapes(position, run["lattice/nodes"][:], run["lattice/mass"][:])


def distance_of_shapes(x: np.ndarray, rest: np.ndarray, mass: np.ndarray) -> float:
    """Distance of nodes x (n, 3) from ``rest`` (n, 3) after the best rigid motion, over the body's longest side [-].

        min over R, c of sqrt( sum_i m_i |x_i - R rest_i - c|^2 / sum_i m_i ) / side

    R is a rotation: a mirrored body is not in its rest shape. (Kabsch 1976, as scipy has it.)
    """
    side = np.ptp(rest, axis=0).max()
    if side == 0:  # one node
        return 0.0
    x, rest = (points - mass @ points / mass.sum() for points in (x, rest))
    size = max(np.abs(x).max(), side)  # what has flown apart must not overflow
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of a flat body several rotations are the best: any will do
        rotation, _ = Rotation.align_vectors(x / size, rest / size, weights=mass / mass.sum())
    squared = ((x - rotation.apply(rest)) ** 2).sum(axis=1) / size**2  # scipy's own figure ends at 1e-8
    return float(np.sqrt(mass @ squared / mass.sum()) * size / side)
