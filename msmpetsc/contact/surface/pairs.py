"""Contacts of a surface with itself and with obstacles, wherever they are: looked for as rarely as can be.

Pairs of its parts that may meet are looked for around positions, and again where a point has moved farther than was
allowed for then; a common translation is no such move. Where none of them can come near, positions of nodes tell that
without a single point's being computed; elsewhere points tell, for light nodes around a body swing much farther. Pairs
outlive a step (``NearPairs``); contacts at positions are known for as long as it lasts (``Contacts``).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Positions, Rows
from msmpetsc.comm import log, on_root
from msmpetsc.contact.surface.barrier import PIECE, Barrier, BarrierLaw, ContactSets
from msmpetsc.contact.surface.creases import NEAREST
from msmpetsc.contact.surface.points import SurfacePoints
from msmpetsc.geometry.surface import Surface

if TYPE_CHECKING:
    import ipctk

REMEMBERED = 3  # positions whose contacts are kept, and pairs: where a line search starts, and where it tries
FARTHEST = 0.05  # edges that a point may move before pairs are looked for anew: with 0.25 there are 4 times the pairs
LEAST = 0.02  # edges that it may always move: fewer pairs are no faster
AHEAD = 2.0  # times the move of a step in which nothing touched
TINY = np.finfo(float).tiny


@dataclass(frozen=True)
class CollisionSurface:
    """The surface that meets itself or obstacles.

    surface      : on rank 0, triangles that cut others taken out, and the obstacles'; None on the others
    points       : its points as the nodes carry them
    meets_itself : or obstacles alone
    """

    surface: Surface | None
    points: SurfacePoints
    law: BarrierLaw
    meets_itself: bool


@dataclass(frozen=True)
class Touch:
    """Contacts of one moment: their number, the least distance [m], NaN where there are none, and the energy [J]."""

    contacts: int = 0
    distance: float = np.nan
    energy: float = 0.0


@dataclass(frozen=True)
class Pairs:
    """Pairs that may meet while no point is farther than ``reach`` [m] from where it is at q (owned, 3), or from its
    straight way from there, but for a translation.

    time               : [s], at which obstacles are there as they are
    apart              : no more than reach [m]; none of them comes near enough to count while no point moves farther
    clear              : no more than that [m]; nor does any pair in a crease, which is not among them
    points, candidates : S there (p, 3) [m] and the pairs, on rank 0
    moved              : the ways (p, 3) [m], on rank 0; None where there are none
    """

    q: Positions
    time: float
    reach: float
    apart: float
    clear: float
    points: Positions
    candidates: "ipctk.Candidates | None"
    moved: Rows | None = None

    def serve(self, points: Positions) -> bool:
        """Return whether points S (p, 3) are within reach, on rank 0."""
        gone = points - self.points
        if self.moved is not None:
            gone, way = gone - gone.mean(axis=0), self.moved - self.moved.mean(axis=0)
            gone -= np.clip(np.vdot(gone, way) / (np.vdot(way, way) + TINY), 0.0, 1.0) * way
        return farthest(gone) <= self.reach


@dataclass(frozen=True)
class ContactsAt:
    """Contacts at positions q (owned, 3) [m] and a time [s] of obstacles.

    count    : their number
    points   : S (p, 3) [m], on rank 0; none where nothing was near
    contacts : on rank 0; none where nothing was near
    """

    q: Positions
    time: float
    count: int
    points: Positions
    contacts: ContactSets


class NearPairs:
    """Pairs that may meet, as a run knows them. All methods are collective; positions are (owned or more, 3) [m].

    barrier : on rank 0
    edge    : mean length of the surface's edges at rest [m]
    """

    def __init__(self, comm: MPI.Comm, collision: CollisionSurface):
        self.comm, self.points, self.law = comm, collision.points, collision.law
        self.owned, surface = collision.points.weights.shape[1], collision.surface
        self.barrier: Barrier | None = on_root(comm, lambda: _barrier(surface, collision) if surface else None)
        self.edge: float = comm.bcast(self.barrier.edge if self.barrier else 0.0)
        self._known: list[Pairs] = []  # the newest first

    def around(self, q: Positions, time: float) -> Pairs:
        """Return the newest pairs; those at q if there are none yet."""
        return self._known[0] if self._known else self.look(q, time, self.law.distance)

    def serving(self, *places: Positions) -> Pairs | None:
        """Return the newest pairs within whose reach all of these places of points S (p, 3) are, by their own moves."""
        known = enumerate(self._known if self.barrier else ())
        number: int | None = self.comm.bcast(next((i for i, pairs in known if all(map(pairs.serve, places))), None))
        if number is None:
            return None
        self._known.insert(0, self._known.pop(number))
        return self._known[0]

    def look(self, q: Positions, time: float, reach: float, moved: Rows | None = None) -> Pairs:
        """Look for pairs at q, or on the way of the points from there by ``moved`` (p, 3) [m]."""
        points, reach = self.points(q, time), min(max(reach, LEAST * self.edge), FARTHEST * self.edge)
        candidates, ways = None, (0.0, 0.0)
        if self.barrier:
            candidates = self.barrier.candidates(points, reach, moved)
            if moved is None:
                ways = self.barrier.clear_reach(candidates, points, reach)
        apart, clear = self.comm.bcast(ways)
        newest = Pairs(q[: self.owned].copy(), time, reach, apart, clear, points, candidates, moved)
        self._known = [newest, *self._known[: REMEMBERED - 1]]
        return newest

    def moved(self, q: Positions, time: float, pairs: Pairs) -> float:
        """Return no less than how far points at q are from where the pairs were looked for [m]."""
        return self.farthest(q, pairs.q, time, pairs.time)

    def farthest(self, end: Positions, start: Positions, time: float, begin: float) -> float:
        """Return no less than how far any point goes when nodes go from start to end, but for a translation [m]."""
        moved = end[: self.owned] - start[: self.owned]
        if self.points.obstacles.total:
            moved = np.vstack([moved, self.points.obstacles.way(begin, time)])
        along = np.ascontiguousarray(moved.T)  # along the last axis numpy takes a twentieth of the time
        ends = [np.fmax.reduce(along, axis=1, initial=-np.inf), -np.fmin.reduce(along, axis=1, initial=np.inf)]
        ends = np.concatenate(ends)
        self.comm.Allreduce(MPI.IN_PLACE, ends, MPI.MAX)  # the greatest along the axes and against them
        return float(self.points.spread * 0.5 * np.linalg.norm(ends[:3] + ends[3:]))

    def forget(self) -> None:
        """Forget what earlier steps showed."""
        self._known = []
        if self.barrier:
            self.barrier.rubbed = None


class Contacts:
    """Contacts in a step from ``begin`` to ``time`` [s]. All methods are collective.

    Positions are (owned or more, 3) [m]. Obstacles are where they are at the step's end if nothing else is said: they
    get there first.

    before : contacts of the step before, whose end is known
    """

    def __init__(self, near: NearPairs, begin: float, time: float, before: "Contacts | None" = None):
        self.begin, self.time = begin, time
        self.near, self.comm, self.points, self.law = near, near.comm, near.points, near.law
        self.barrier, self.owned, self.obstacles = near.barrier, near.owned, near.points.obstacles
        self._moments: list[ContactsAt] = before._moments if before else []
        # q, time and points of some positions
        self._points: list[tuple[Positions, float, Positions]] = before._points if before else []

    def find(
        self, q: Positions, time: float | None = None, with_points: bool = False, base: Positions | None = None
    ) -> ContactsAt:
        """Return the contacts at positions q, and a time [s] if not that of the step's end.

        with_points : these are there, even if nothing is near
        base        : where a way to q begins, of which it is then asked how much of it is free
        """
        q, time = q[: self.owned], self.time if time is None else time
        for moment in self._moments:
            if self._is_at(moment.q, moment.time, q, time):
                return moment
        pairs = self.near.around(q, time)
        bound = self.near.moved(q, time, pairs)
        if bound < pairs.clear and not with_points:
            return ContactsAt(q, time, 0, np.empty((0, 3)), ())
        points, candidates = self.points_at(q, time), None
        if bound >= pairs.apart:
            if bound > pairs.reach:
                pairs = self.near.serving(points) or self._look(q, time, points, base)
            candidates = pairs.candidates
        contacts = self.barrier.contacts(candidates, points) if self.barrier else ()
        count = self.comm.bcast(sum(map(len, contacts)))
        self._moments = [ContactsAt(q.copy(), time, count, points, contacts), *self._moments[: REMEMBERED - 1]]
        return self._moments[0]

    def after_way(self, q: Positions, x: Positions) -> tuple[bool, bool]:
        """Return whether the way of a step from q to x is free, and whether the surface touches something at x."""
        pairs, bound = self._bound(q, self.begin, x)
        ahead = AHEAD * self.near.farthest(x, q, self.time, self.begin)
        if bound > pairs.reach and ahead <= FARTHEST * self.near.edge:  # so that the next steps need no look
            self.near.look(x, self.time, ahead)
        touches = self.find(x, base=q).count > 0
        return self.free_share(q, x, True) == 1.0, touches

    def _look(self, q: Positions, time: float, points: Positions, base: Positions | None) -> Pairs:
        """Look for pairs at q, whose points are S (p, 3) [m], and on the way there from base, if that is not long."""
        moved = None if base is None else self.points_at(base, time) - points
        if self.comm.bcast(moved is not None and len(moved) > 0 and farthest(moved) > PIECE * self.near.edge):
            moved = None
        return self.near.look(q, time, LEAST * self.near.edge, moved)

    def points_at(self, q: Positions, time: float) -> Positions:
        """Return the points (p, 3) [m] of positions q at a time [s] on rank 0; (0, 3) on the others."""
        q = q[: self.owned]
        for known, at, points in self._points:
            if self._is_at(known, at, q, time):
                return points
        self._points = [(q.copy(), time, self.points(q, time)), *self._points[: REMEMBERED - 1]]
        return self._points[0][2]

    def _is_at(self, known: Positions, at: float, q: Positions, time: float) -> bool:
        """Return whether positions and obstacles are those of another moment on all ranks."""
        return self.same(at, time) and self.comm.allreduce(bool(np.array_equal(q, known)), MPI.LAND)

    def same(self, begin: float, end: float) -> bool:
        """Return whether obstacles are at one time [s] where they are at another."""
        return not self.obstacles.moves(begin, end)

    def touch(self, q: Positions, time: float) -> Touch:
        """Return what there is of contacts at q and a time [s]."""
        moment = self.find(q, time)
        touch = Touch()
        if self.barrier and moment.count:
            least = self.barrier.least(moment.contacts, moment.points)
            touch = Touch(moment.count, least, self.barrier.energy(moment.contacts, moment.points))
        of_all: Touch = self.comm.bcast(touch)
        return of_all

    def _bound(self, q: Positions, begin: float, end: Positions) -> tuple[Pairs, float]:
        """Return the newest pairs, and no less than how far points are from them on a way from q at ``begin`` [s]."""
        pairs = self.near.around(q, begin)
        return pairs, max(self.near.moved(q, begin, pairs), self.near.moved(end, self.time, pairs))

    def free_share(self, q: Positions, end: Positions, with_obstacles: bool = False) -> float:
        """Return the share, up to 1, of the straight way from q to ``end`` that no two triangles meet on.

        with_obstacles : these go from where they are when the step begins
        """
        begin = self.begin if with_obstacles else self.time
        pairs, bound = self._bound(q, begin, end)
        if bound < pairs.clear:
            return 1.0
        contacts, start = self.find(q, begin).contacts, self.points_at(q, begin)
        moved, (pairs, bound) = self.points_at(end, self.time) - start, self._bound(q, begin, end)
        way = self.comm.bcast(farthest(moved) if self.barrier else 0.0)
        clearance = self.barrier.clearance(contacts, start) if self.barrier and contacts else 0.0
        if 2 * way < self.comm.bcast(clearance):
            return 1.0
        candidates = None
        if bound >= pairs.apart:
            # pairs that serve at its end alone say nothing of what is passed on the way there
            serving = self.near.serving(start, start + moved)
            if not serving and way > PIECE * self.near.edge:
                return float(self.comm.bcast(self.barrier.sweep(start, moved) if self.barrier else 1.0))
            candidates = (serving or self.near.look(q, begin, LEAST * self.near.edge, moved)).candidates
        return float(self.comm.bcast(self.barrier.free_share(start, moved, candidates) if self.barrier else 1.0))


def farthest(moved: Rows) -> float:
    """Return no less than how far any of some points goes that move so (p, 3) [m], but for a common translation."""
    along = np.ascontiguousarray(moved.T)
    middle = 0.5 * (along.max(axis=1) + along.min(axis=1))
    return float(np.sqrt(((along - middle[:, None]) ** 2).sum(axis=0).max()))


def _barrier(surface: Surface, collision: CollisionSurface) -> Barrier:
    law = collision.law
    barrier = Barrier(surface, law, collision.points.bodies, collision.meets_itself)
    folded, dropped = barrier.leave_out_neighbours(surface.points)
    if folded:
        log.info(
            "self_contact: %d pairs of the surface's parts are in creases, nearer than self_contact.distance = %.3g m "
            "at rest or next to such: they push each other from smaller distances, down to %.3g m",
            folded, law.distance, barrier.distances[-1],
        )  # fmt: skip
    if dropped:
        log.warning(
            "self_contact: %d pairs of the surface's parts in creases all but touch at rest, nearer than %.3g m: they "
            "are left out, and may cross", dropped, NEAREST * law.distance,
        )  # fmt: skip
    return barrier
