"""Rigid motions of bodies that no spring holds, kept exactly: nothing falls, drifts or spins by what a cycle leaves.

With R the rigid motions and Q = R (R^T M R)^-1 R^T M, a cycle B becomes (I - Q) B (I - Q)^T + R (R^T M R)^-1 R^T. As
translations are eigenvectors of M^-1 H, forces that balance then never move a body as a whole.
"""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import like, to_host
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.bodies import Bodies


class RigidMotions:
    """Those of the free bodies, about positions that ``follow`` takes. All methods are collective.

    body    : (m,) which of the free ones a free node belongs to; their number where its body is held
    mass    : (b,) of each [kg]
    inertia : (b, 3, 3) pseudoinverse of each one's moments of inertia [1/(kg m^2)]
    arm     : (3, m) from its centre of mass to each node [m]
    """

    def __init__(self, comm: MPI.Comm, unknowns: Unknowns, bodies: Bodies):
        self.comm, self.unknowns = comm, unknowns
        nodes = unknowns.lattice.nodes
        self.count = int(bodies.free.sum())
        rank = np.where(bodies.free, np.cumsum(bodies.free) - 1, self.count)
        self.body = like(nodes, rank[bodies.number[to_host(unknowns.free)]])
        self.of_node = unknowns.lattice.mass[unknowns.free]
        self.mass = self._sums(self.of_node[None])[:, 0]
        self.arm = np.zeros((3, unknowns.size), like=nodes)
        self.inertia = np.zeros((self.count, 3, 3))

    def follow(self, q: np.ndarray) -> None:
        """Take the motions about positions q (l, 3) [m]."""
        at, m = q[self.unknowns.free].T, self.of_node
        centres = self._sums(m * at) / self.mass[:, None]
        self.arm = (at - self._spread(centres)) * (self.body < self.count)
        x, y, z = self.arm
        xx, yy, zz, xy, xz, yz = self._sums(m * np.stack([x * x, y * y, z * z, x * y, x * z, y * z])).T
        moments = np.array([[yy + zz, -xy, -xz], [-xy, xx + zz, -yz], [-xz, -yz, xx + yy]]).transpose(2, 0, 1)
        self.inertia = np.linalg.pinv(moments, rcond=1e-12, hermitian=True)

    def of(self, forces: np.ndarray) -> np.ndarray:
        """Return R (R^T M R)^-1 R^T f, (3, m), of f (3, m)."""
        x, y, z = self.arm
        a, b, c = forces
        sums = self._sums(np.stack([a, b, c, y * c - z * b, z * a - x * c, x * b - y * a]))
        shift, turn = sums[:, :3] / self.mass[:, None], np.einsum("bij,bj->bi", self.inertia, sums[:, 3:])
        (u, v, w), (p, q, r) = self._spread(shift), self._spread(turn)
        return np.stack([u + q * z - r * y, v + r * x - p * z, w + p * y - q * x])

    def around(self, cycle: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Apply to x what a cycle becomes, into y."""
        unknowns = self.unknowns
        forces = unknowns.columns(x)
        rigid, rest = self.of(forces), x.duplicate()
        unknowns.columns_to_write(rest)[:] = forces - self.of_node * rigid
        cycle.apply(rest, y)
        rest.destroy()
        moved = unknowns.columns_to_write(y)
        moved += rigid - self.of(self.of_node * moved)

    def _sums(self, rows: np.ndarray) -> np.ndarray:
        """Sums (b, r) over each free body's nodes of rows (r, m)."""
        own = [to_host(np.bincount(self.body, row, self.count + 1)[: self.count]) for row in rows]
        return self.comm.allreduce(np.array(own).reshape(len(rows), self.count)).T

    def _spread(self, values: np.ndarray) -> np.ndarray:
        """Values (3, m) of each node from those (b, 3) of the free bodies, 0 in the others."""
        return like(self.arm, np.append(values, np.zeros((1, 3)), axis=0).T.copy())[:, self.body]
