"""Points of surfaces in contact: the points S = W q of bodies, then the points of obstacles.

Each rank has the columns of W for its nodes. S is the sum of the ranks' contributions on rank 0,
which has the surface mesh. A force f on the points is W^T f on each rank's nodes.
"""

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array, csr_array

from msmpetsc.backend.arrays import Indices, Positions, Rows
from msmpetsc.comm import Route, reduced
from msmpetsc.contact.surface.obstacle_surfaces import ObstacleSurfaces
from msmpetsc.lattice.lattice import Lattice


class SurfacePoints:
    """Matrix W, stored by columns. All methods but ``carried`` are collective.

    bodies  : number of points of bodies
    total   : number of points, obstacles included
    spread  : greatest sum of a point's absolute weights; no point moves more than ``spread`` times
              as far as a node
    rows    : (k,) points that nodes of this rank carry, ascending
    weights : (k, owned) weights of the nodes in these points
    sums    : (total, s) matrix that adds the contributions of all ranks, in their order, on rank 0
    """

    def __init__(
        self, comm: MPI.Comm, lattice: Lattice, embedding: csr_array, obstacles: ObstacleSurfaces
    ):
        counts = comm.allgather(embedding.shape[0])
        self.comm, self.obstacles, self.bodies = comm, obstacles, sum(counts)
        self.total = self.bodies + obstacles.total
        sizes = abs(embedding).sum(axis=1)
        self.spread = reduced(comm, float(sizes.max(initial=0)), MPI.MAX)
        to_owner = Route(comm, lattice.table.owner_of_index(embedding.indices))
        numbers = sum(counts[: comm.rank]) + np.arange(embedding.shape[0])
        points = to_owner.send(np.repeat(numbers, np.diff(embedding.indptr)))
        nodes = to_owner.send(embedding.indices) - lattice.table.first
        self.rows, row = np.unique(points, return_inverse=True)
        shape = (len(self.rows), lattice.owned)
        self.weights = coo_array(
            (to_owner.send(embedding.data), (row.ravel(), nodes)), shape=shape
        ).tocsr()
        self.to_root = Route(comm, np.zeros(len(self.rows), np.int64))
        sent = self.to_root.send(self.rows)
        sums = np.ones(len(sent)), (sent, np.arange(len(sent)))
        self.sums = csr_array(sums, shape=(self.total if comm.rank == 0 else 0, len(sent)))

    def __call__(self, q: Positions, time: float) -> Positions:
        """Return the points (total, 3) [m] at q (owned or more, 3) and a time [s], on rank 0."""
        points = self.moved(q)
        if self.obstacles.total and len(points):
            points[self.bodies :] = self.obstacles.points_at(time)
        return points

    def moved(self, v: Rows) -> Rows:
        """Return W v (total, 3) for v (owned or more, 3) on rank 0; (0, 3) elsewhere.

        Rows of obstacles are 0.
        """
        points: Rows = self.sums @ self.to_root.send(self.weights @ v[: self.weights.shape[1]])
        return points

    def distances(self, q: Positions, time: float) -> Rows:
        """Return the least distance (owned, k) [m] of each node's points from each obstacle.

        A node's points count, not the node itself, since a light node may swing far out of the
        surface. A node without points has its own distance.
        """
        points = self(q, time)[: self.bodies]
        of_points = self.comm.bcast(self.obstacles.distances(points, time) if len(points) else None)
        owned = self.weights.shape[1]
        least = np.full((owned, of_points.shape[1]), np.inf)
        carried = self.weights.tocoo()
        np.minimum.at(least, carried.col, of_points[self.rows[carried.row]])
        return np.where(np.isinf(least), self.obstacles.distances(q[:owned], time), least)

    def carried(self, numbers: Indices) -> csr_array:
        """Return the weights (k, owned) of this rank's nodes in points (k,)."""
        row = np.searchsorted(self.rows, numbers)
        at = np.flatnonzero(np.append(self.rows, -1)[row] == numbers)
        chosen = csr_array((np.ones(len(at)), (at, row[at])), shape=(len(numbers), len(self.rows)))
        return csr_array(chosen @ self.weights)
