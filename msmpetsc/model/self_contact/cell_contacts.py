"""Self-contact of a surface that cuts itself all over at rest, which no barrier can begin from: points of it that come
into cells of another part are pushed out by a penalty.

Points in cells are looked for where a step begins (self_contact.cells). In the step each has the depth

    d = d_n + g . (S - S_n - sum_v N_v (q_v - q_vn))

and the energy 1/2 k max(d, 0)^2, which is convex and pushes a point and its cell alike. A point in the part of a
boundary cell that is outside has d_n < 0, and meets the body within the step. Nothing rubs.

The points are on all ranks when they are looked for, as an obstacle's surface is; each rank looks at the cells around
its own nodes.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from mpi4py import MPI

from msmpetsc.geometry.surface import Surface
from msmpetsc.model.self_contact.cells import Cells, Intrusions, Places, intrusions
from msmpetsc.model.self_contact.contacts import Touch
from msmpetsc.model.self_contact.points import Carried, SurfacePoints
from msmpetsc.model.self_contact.term import block_bound


@dataclass(frozen=True)
class OverlappingSurface:
    """A surface that is pushed out of the body's cells.

    surface     : on rank 0; None on the others
    points      : its points as the nodes carry them
    places      : of the points
    stiffness   : (p,) k of each point [N/m]
    cells       : around the nodes of this rank, those that belong to it first
    cells_owned : number of these
    """

    surface: Surface | None
    points: SurfacePoints
    places: Places
    stiffness: np.ndarray
    cells: Cells
    cells_owned: int


class CellContacts:
    """Contacts of one run. All methods are collective; positions are (l, 3) [m]."""

    def __init__(self, comm: MPI.Comm, collision: OverlappingSurface):
        self.comm, self.collision, self.points = comm, collision, collision.points
        self._known: list[CellContact] = []  # where the last step began, and where it ended

    def expect(self, q: np.ndarray, end: np.ndarray) -> None:
        """There is nothing to make ready for a step."""

    def forget(self) -> None:
        """Know nothing of the steps before."""
        self._known = []

    def during(self, q: np.ndarray) -> "CellContact":
        """Return what pushes in a step from q."""
        for known in self._known:
            if self.comm.allreduce(np.array_equal(q, known.start), MPI.LAND):
                return known
        found = intrusions(q, self._points(q), self.collision.cells, self.collision.places)
        self._known = [CellContact(self.comm, self.collision, q.copy(), found), *self._known[:1]]
        return self._known[0]

    def _points(self, q: np.ndarray) -> np.ndarray:
        """Return the points (p, 3) [m] on all ranks."""
        points = self.points(q)
        if self.comm.size > 1:
            points = points if self.comm.rank == 0 else np.empty((self.points.total, 3))
            self.comm.Bcast(points)
        return points

    def touch(self, q: np.ndarray) -> Touch:
        """Return what there is of contacts at q; a depth is a negative distance."""
        return self.during(q).touch()


class CellContact:
    """Contact in one step. All methods but ``concavity`` and ``free_share`` are collective; positions are (l, 3) [m].

    start   : where points were looked for
    found   : those in cells around this rank's nodes; ``owns`` (a,) those in cells that belong to it
    corners : (a, 8) local nodes of their cells; ``stiffness`` (a,) [N/m]
    touched : (k,) numbers of the points of all ranks, ascending; ``rows`` (a,) which of those each is
    carried : those, as this rank's nodes carry them
    """

    def __init__(self, comm: MPI.Comm, collision: OverlappingSurface, start: np.ndarray, found: Intrusions):
        self.comm, self.start, self.found = comm, start, found
        self.owned = collision.points.weights.shape[1]
        self.owns = found.cell < collision.cells_owned
        self.corners, self.stiffness = collision.cells.corners[found.cell], collision.stiffness[found.point]
        self.touched = np.unique(np.concatenate(comm.allgather(found.point[self.owns])))
        self.rows = np.searchsorted(self.touched, found.point)
        self.carried: Carried = collision.points.carried(self.touched)

    def touch(self) -> Touch:
        """Return what there is of contacts at the step's start."""
        deep = np.maximum(self.found.depth, 0.0)[self.owns]
        energy = 0.5 * float(self.stiffness[self.owns] @ deep**2)
        count, energy = self.comm.allreduce(np.array([np.count_nonzero(deep), energy]))
        deepest = self.comm.allreduce(deep.max(initial=0.0), MPI.MAX)
        return Touch(int(count), -deepest, float(energy)) if count else Touch()

    def deeper(self, moved: np.ndarray) -> np.ndarray:
        """Return how much deeper each point is (a,) [m] when nodes have moved so (l, 3) [m]."""
        at, weights = self.carried
        points = np.zeros((len(self.touched), 3))
        points[at] = weights @ moved[: self.owned]
        of_cells = np.einsum("av,avk->ak", self.found.weights, moved[self.corners])
        return (self.found.way_out * (self.sum(points)[self.rows] - of_cells)).sum(axis=1)

    def sum(self, rows: np.ndarray) -> np.ndarray:
        """Return the sum over all ranks."""
        if self.comm.size == 1:
            return rows
        total = np.empty_like(rows)
        self.comm.Allreduce(rows, total)
        return total

    def depths(self, q: np.ndarray) -> np.ndarray:
        """Return how deep each point is at q (a,) [m], negative outside."""
        return self.found.depth + self.deeper(q - self.start)

    def presses(self, q: np.ndarray) -> bool:
        """Return whether any point is pushed at q."""
        return self.comm.allreduce(bool((self.depths(q) > 0).any()), MPI.LOR)

    def free_share(self, q: np.ndarray, end: np.ndarray) -> float:
        """Return 1: nothing is kept from meeting."""
        return 1.0

    def change(self, q: np.ndarray, base: np.ndarray) -> float:
        """Return this rank's part of the energy at q less that at base [J], from how much deeper points are."""
        deep, before, deeper = self.depths(q), self.depths(base), self.deeper(q - base)
        both = (deep > 0) & (before > 0)
        deep, before = np.maximum(deep, 0.0), np.maximum(before, 0.0)
        change = 0.5 * self.stiffness * (deep + before) * np.where(both, deeper, deep - before)
        return float(change[self.owns].sum())

    def add_gradient(self, q: np.ndarray, gradient: np.ndarray) -> None:
        """Add its gradient [N] to the owned rows of ``gradient``."""
        self.add_forces(self.stiffness * np.maximum(self.depths(q), 0.0), gradient)

    def add_forces(self, forces: np.ndarray, rows: np.ndarray) -> None:
        """Add forces along the ways out, (a,) of them, on the points, and against them on their cells, to the owned
        ``rows``."""
        at, weights = self.carried
        vectors, own = forces[:, None] * self.found.way_out, self.corners < self.owned
        np.add.at(rows, self.corners[own], (-self.found.weights[:, :, None] * vectors[:, None])[own])
        on_points = np.zeros((len(self.touched), 3))
        np.add.at(on_points, self.rows[self.owns], vectors[self.owns])
        rows[: self.owned] += weights.T @ self.sum(on_points)[at]

    def hessian(self, q: np.ndarray, projected: bool) -> "CellHessian | None":
        """Return the Hessian at q, which has no negative part; None where nothing is pushed."""
        pushed = self.depths(q) > 0
        if not self.comm.allreduce(bool(pushed.any()), MPI.LOR):
            return None
        return CellHessian(self, np.where(pushed, self.stiffness, 0.0))

    def concavity(self, q: np.ndarray) -> np.ndarray:
        """Return zeros (owned,) [N/m]: the Hessian has no negative part."""
        return np.zeros(self.owned)

    def bound(self, q: np.ndarray) -> np.ndarray:
        """Return (owned,) [N/m] no less than each block of the Hessian: powers of 4, which change seldom."""
        hessian = self.hessian(q, True)
        return np.zeros(self.owned) if hessian is None else block_bound(hessian.blocks)


@dataclass(frozen=True)
class CellHessian:
    """sum k (e g)(e g)^T over the points pushed, e the way of a point less that of its cell; stiffness (a,) [N/m]."""

    contact: CellContact
    stiffness: np.ndarray

    def add_product(self, v: np.ndarray, product: np.ndarray) -> None:
        """Add the Hessian times v (l, 3) to the owned rows of ``product`` (collective)."""
        self.contact.add_forces(self.stiffness * self.contact.deeper(v), product)

    @cached_property
    def blocks(self) -> np.ndarray:
        """The 3 x 3 blocks (owned, 9) [N/m] of its diagonal, but for nodes that carry both a point and its cell."""
        contact, found = self.contact, self.contact.found
        (at, weights), owns = contact.carried, contact.owns
        squares = (self.stiffness[:, None, None] * found.way_out[:, :, None] * found.way_out[:, None]).reshape(-1, 9)
        blocks, own = np.zeros((contact.owned, 9)), contact.corners < contact.owned
        np.add.at(blocks, contact.corners[own], (found.weights[:, :, None] ** 2 * squares[:, None])[own])
        of_points = np.zeros((len(contact.touched), 9))
        np.add.at(of_points, contact.rows[owns], squares[owns])
        return blocks + (weights * weights).T @ contact.sum(of_points)[at]
