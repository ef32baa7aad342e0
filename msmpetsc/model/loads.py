"""Forces that act on parts of a body."""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from msmpetsc.model.paths import within


@dataclass(frozen=True)
class Load:
    """A force of nodes: force (owned, 3) [N], acting while start <= time < stop [s]; None: to the end."""

    force: np.ndarray
    start: float
    stop: float | None

    def acts_at(self, time: float) -> bool:
        return within(time, self.start, self.stop)


def spread_by_mass(comm: MPI.Comm, total: tuple[float, ...], where: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """A total force [N] shared out over the nodes ``where`` (owned,) bool in proportion to their mass, (owned, 3) [N]."""
    share = np.where(where, mass, 0.0)
    whole = comm.allreduce(share.sum())
    return share[:, None] / whole * np.asarray(total)
