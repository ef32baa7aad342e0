"""Translations of bodies that no spring holds, kept exactly: nothing falls or drifts by what a cycle leaves.

With T the translations and Q = T (T^T M T)^-1 T^T M, a cycle B becomes (I - Q) B (I - Q)^T + T (T^T M T)^-1 T^T. They
are eigenvectors of M^-1 H, so that forces that balance never move a body as a whole.
"""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import like, to_host
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.bodies import Bodies


class Translations:
    """Those of the free bodies. All methods are collective.

    body : (m,) which of the free ones a free node belongs to; their number where its body is held
    mass : (m,) of each free node [kg]
    of_body : (b,) of each free body [kg]
    """

    def __init__(self, comm: MPI.Comm, unknowns: Unknowns, bodies: Bodies):
        self.comm, self.unknowns, self.count = comm, unknowns, int(bodies.free.sum())
        rank = np.where(bodies.free, np.cumsum(bodies.free) - 1, self.count)
        self.body = like(unknowns.lattice.nodes, rank[bodies.number[to_host(unknowns.free)]])
        self.mass = unknowns.lattice.mass[unknowns.free]
        self.of_body = self._sums(self.mass[None])[0]

    def of(self, forces: np.ndarray) -> np.ndarray:
        """Return T (T^T M T)^-1 T^T f, (3, m), of f (3, m)."""
        moved = self._sums(forces) / self.of_body
        return like(forces, np.append(moved, np.zeros((3, 1)), axis=1))[:, self.body]

    def around(self, cycle: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Apply to x what a cycle becomes, into y."""
        unknowns = self.unknowns
        forces, rest = unknowns.columns(x), x.duplicate()
        whole = self.of(forces)
        unknowns.columns_to_write(rest)[:] = forces - self.mass * whole
        cycle.apply(rest, y)
        rest.destroy()
        moved = unknowns.columns_to_write(y)
        moved += whole - self.of(self.mass * moved)

    def _sums(self, rows: np.ndarray) -> np.ndarray:
        """Sums (r, b) over each free body's nodes of rows (r, m)."""
        own = [to_host(np.bincount(self.body, row, self.count + 1)[: self.count]) for row in rows]
        return self.comm.allreduce(np.array(own).reshape(len(rows), self.count))
