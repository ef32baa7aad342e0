"""Local error of a step: what it adds to the error of the trajectory.

From positions q and velocities v at a step's two ends,

    implicit Euler  t/2 (v_(n+1) - v_n)                            = t^2/2 a  + O(t^3)
    BDF2            8/5 (q_(n+1) - q_n - t/2 (v_n + v_(n+1)))      = 2/9 t^3 da/dt + O(t^4)

Waves as short as a cell have the most of it and move next to nothing: an impact's would have each step resolve them,
and so keep them, where longer steps damp them. So errors are means over neighbours, taken a few times.
"""

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

from msmpetsc.backend.arrays import like, to_host
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.solve.linear.ghosted import Ghosted

SWEEPS = 4


def euler_error(q: np.ndarray, v: np.ndarray, x: np.ndarray, w: np.ndarray, time_step: float) -> np.ndarray:
    """Local error (n, 3) [m] of a step of implicit Euler from q with velocity v to x with velocity w."""
    return 0.5 * time_step * (w - v)


def bdf2_error(q: np.ndarray, v: np.ndarray, x: np.ndarray, w: np.ndarray, time_step: float) -> np.ndarray:
    """The same of BDF2."""
    return 1.6 * (x - q - 0.5 * time_step * (v + w))


METHODS = {"implicit-euler": (1, euler_error), "bdf2": (2, bdf2_error)}  # order, local error


class NeighbourMean:
    """Means over a node and all that springs join it to, ``SWEEPS`` times. All methods are collective."""

    def __init__(self, comm: MPI.Comm, lattice: Lattice):
        self.owned, self.field = lattice.owned, Ghosted(comm, lattice)
        ends, nodes = to_host(lattice.springs), np.arange(len(lattice.nodes))
        rows, columns = np.r_[ends[:, 0], ends[:, 1], nodes], np.r_[ends[:, 1], ends[:, 0], nodes]
        own = rows < lattice.owned  # all springs at them are known here
        shape = lattice.owned, len(nodes)
        joined = csr_array((np.ones(own.sum()), (rows[own], columns[own])), shape=shape)
        self.weights = csr_array(joined.multiply(1 / joined.sum(axis=1)[:, None]))

    def __call__(self, vectors: np.ndarray) -> np.ndarray:
        """Of (owned, 3)."""
        for _ in range(SWEEPS):
            self.field.values[: self.owned] = vectors
            self.field.update()
            vectors = like(vectors, self.weights @ to_host(self.field.values))
        return vectors

    def destroy(self) -> None:
        self.field.destroy()
