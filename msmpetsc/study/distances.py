"""Distances of motions: the shape error, from the rest shape; trajectory and surface error, from the true motion."""

import math
import warnings
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from msmpetsc.errors import InputError
from msmpetsc.results.comparison import common_times, refuse_different_lattices
from msmpetsc.results.reader import Result
from msmpetsc.results.surfaces import surface_distance


def shape_error(run: Result, frame: int) -> float | None:
    """Return ``distance_of_shapes`` for a frame of a result; None where a position is not finite.

    Of several bodies it is that of the one that is farthest from its shape.
    """
    position = run.frames.position[frame]
    if not np.isfinite(position).all():
        return None
    rest, mass, body = run["lattice/nodes"][:], run["lattice/mass"][:], run.body_of("lattice")
    of_bodies = (body == number for number in np.unique(body))
    return max(distance_of_shapes(position[own], rest[own], mass[own]) for own in of_bodies)


def distance_of_shapes(x: np.ndarray, rest: np.ndarray, mass: np.ndarray) -> float:
    """Return the distance of nodes x (n, 3) from ``rest`` (n, 3) after the best rigid motion, over the longest side.

        min over R, c of sqrt( sum_i m_i |x_i - R rest_i - c|^2 / sum_i m_i ) / side    [-]

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


def trajectory_error(result: Path, reference: Path) -> float:
    """Return the distance of a run from a reference run, relative to how far the reference has moved [-].

        sqrt( sum_times |x - x_ref|_M^2 / sum_times |x_ref - x_rest|_M^2 )

    Sums over the times that both files have, masses M and rest positions of the lattice. x_ref stands for the limit
    of the time step to zero, so this is the error of the time step and of unfinished steps together, unlike the
    step error, which knows the step alone. Nothing else is subtracted: a body that flies as a whole counts its
    flight as motion, so the same error of its shape is a smaller figure there than of one that only swings.

    Raises InputError if the files have fewer than two times in common or different lattices, or nothing moves.
    """
    with Result(result) as run, Result(reference) as true:
        refuse_different_lattices(run, true)
        rest, mass = true["lattice/nodes"][:], true["lattice/mass"][:]
        pairs = common_times(run.frames.time[:], true.frames.time[:])
        if len(pairs) < 2:
            raise InputError(f"{result} and {reference} have {len(pairs)} times in common, 2 are needed")
        off = moved = 0.0
        for of_run, of_reference in pairs:
            x, x_ref = run.frames.position[of_run], true.frames.position[of_reference]
            off += mass @ ((x - x_ref) ** 2).sum(axis=1)
            moved += mass @ ((x_ref - rest) ** 2).sum(axis=1)
    if moved == 0:
        raise InputError(f"{reference}: nothing moves in it")
    return float(np.sqrt(off / moved))


def surface_error(result: Path, reference: Path, until: float = math.inf) -> float:
    """Return the distance of a run's surface from that of a reference run, of any lattice of the same mesh [-].

        sqrt( mean over times and area of |s - s_ref|^2 ) / greatest |s_ref - s_rest|

    until : times after it do not count [s]

    The reference stands for the body itself: this is the error of cells, time step and unfinished steps together.

    Raises InputError if the meshes differ, a surface was not stored, there is no common time, or nothing moves.
    """
    with Result(result) as run, Result(reference) as true:
        distance = surface_distance(run, true, until)
    if distance.moved == 0:
        raise InputError(f"{reference}: nothing moves in it")
    return distance.overall / distance.moved
