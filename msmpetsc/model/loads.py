"""Regions of a body, and the forces that act on them."""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from msmpetsc.errors import InputError
from msmpetsc.scene import Region

EDGE = 1e-9  # of the body's longest side: a node this near to a region counts as on its edge, whatever was rounded


@dataclass(frozen=True)
class Load:
    """A force of nodes: force (owned, 3) [N], acting while start <= time < stop [s]."""

    force: np.ndarray
    start: float
    stop: float

    def acts_at(self, time: float) -> bool:
        return self.start <= time < self.stop


def inside(region: Region, points: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Which points (n, 3) [m] lie in a region or on its edge, (n,) bool.

    bounds : (2, 3) the body's bounding box at rest [m]
    """
    sides = bounds[1] - bounds[0]
    origin, scale, length = (bounds[0], sides, sides.max()) if region.relative else (np.zeros(3), np.ones(3), 1.0)
    edge = EDGE * sides.max()

    def place(point: tuple[float, ...]) -> np.ndarray:
        return origin + np.asarray(point) * scale

    if region.box is not None:
        low, high = region.box
        return ((points >= place(low) - edge) & (points <= place(high) + edge)).all(axis=1)
    if region.sphere is not None:
        distance = np.linalg.norm(points - place(region.sphere.center), axis=1)
        return distance <= region.sphere.radius * length + edge
    return (points - place(region.half_space.point)) @ np.asarray(region.half_space.normal) >= -edge


def spread_by_mass(comm: MPI.Comm, total: tuple[float, ...], where: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """A total force [N] shared out over the nodes ``where`` (owned,) bool in proportion to their mass, (owned, 3) [N]."""
    share = np.where(where, mass, 0.0)
    whole = comm.allreduce(share.sum())
    return share[:, None] / whole * np.asarray(total)


def check_not_empty(comm: MPI.Comm, key: str, where: np.ndarray) -> None:
    """Raise InputError on all ranks if a region holds no node."""
    if comm.allreduce(int(where.sum())) == 0:
        raise InputError(f"{key}.region holds no node of the lattice")
