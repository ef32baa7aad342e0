"""Contacts of a surface with itself and with obstacles, wherever they are: looked for as rarely as can be.

Pairs of its parts that may meet are looked for where a step begins, and again where a point has moved farther than was
allowed for then; a common translation is no such move. Where none of them can come near, positions of nodes tell that
without a single point's being computed. Pairs outlive a step (``NearPairs``); contacts at positions and pairs on ways
are known for as long as it lasts (``Contacts``).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Positions, Rows
from msmpetsc.comm import log, on_root
from msmpetsc.contact.surface.barrier import Barrier, BarrierLaw, ContactSets, SweptPairs, energy_of
from msmpetsc.contact.surface.creases import NEAREST
from msmpetsc.contact.surface.points import SurfacePoints
from msmpetsc.geometry.surface import Surface

if TYPE_CHECKING:
    import ipctk

REMEMBERED = 3  # positions whose contacts are kept: where a line search starts, and where it tries
FARTHEST = 0.1  # edges that a point may move before pairs are looked for anew: with 0.25 there are four times the pairs
ASIDE = 1e-3  # of the barrier's distance: positions so near a way are on it
AHEAD = 2.0  # times the move that is expected


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
    """Pairs that may meet while no point moves by more than ``reach`` [m] from q (owned, 3), but for a translation.

    time               : [s], at which obstacles are there as they are
    apart              : no more than reach [m]; none of them comes near enough to count while no point moves farther
    clear              : no more than that [m]; nor does any pair in a crease, which is not among them
    points, candidates : S there (p, 3) [m] and the pairs, on rank 0
    """

    q: Positions
    time: float
    reach: float
    apart: float
    clear: float
    points: Positions
    candidates: "ipctk.Candidates | None"


@dataclass(frozen=True)
class Way:
    """A straight way from q by ``moved`` (owned, 3) [m] that was swept; the pairs that come near on it, on rank 0.

    square : |moved|^2 of all ranks [m^2]
    """

    q: Positions
    moved: Rows
    square: float
    sweep: SweptPairs | None


@dataclass(frozen=True)
class ContactsAt:
    """Contacts at positions q (owned, 3) [m] and a time [s] of obstacles.

    count    : their number
    points   : S (p, 3) [m], on rank 0; None on all where it was not needed
    contacts : on rank 0
    """

    q: Positions
    time: float
    count: int = 0
    points: Positions | None = None
    contacts: "ContactSets | None" = None


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
        self._newest: Pairs | None = None

    def step(self, q: Positions, end: Positions, begin: float, time: float) -> "Contacts":
        """Return the contacts of a step from q at ``begin`` [s] to about ``end`` at ``time`` [s].

        Pairs are looked for unless the known ones serve.
        """
        pairs = self._newest
        if not (pairs and max(self.moved(q, begin, pairs), self.moved(end, time, pairs)) <= pairs.reach):
            self.look(q, begin, AHEAD * self._farthest(end, q, time, begin))
        return Contacts(self, begin, time)

    def around(self, q: Positions, time: float) -> Pairs:
        """Return the newest pairs; those at q if there are none yet."""
        return self._newest or self.look(q, time, self.law.distance)

    def look(self, q: Positions, time: float, reach: float) -> Pairs:
        """Look for pairs at q."""
        points, reach = self.points(q, time), min(max(reach, self.law.distance), FARTHEST * self.edge)
        candidates, ways = None, (0.0, 0.0)
        if self.barrier:
            candidates = self.barrier.candidates(points, reach)
            ways = self.barrier.clear_reach(candidates, points, reach)
        apart, clear = self.comm.bcast(ways)
        self._newest = Pairs(q[: self.owned].copy(), time, reach, apart, clear, points, candidates)
        return self._newest

    def moved(self, q: Positions, time: float, pairs: Pairs) -> float:
        """Return no less than how far points at q are from where the pairs were looked for [m]."""
        return self._farthest(q, pairs.q, time, pairs.time)

    def _farthest(self, end: Positions, start: Positions, time: float, begin: float) -> float:
        """Return no less than how far any point goes when nodes go from start to end, but for a translation [m]."""
        moved = end[: self.owned] - start[: self.owned]
        if self.points.obstacles.total:
            moved = np.vstack([moved, self.points.obstacles.way(begin, time)])
        ends = np.concatenate([np.fmax.reduce(moved, initial=-np.inf), -np.fmin.reduce(moved, initial=np.inf)])
        self.comm.Allreduce(MPI.IN_PLACE, ends, MPI.MAX)  # the greatest along the axes and against them
        return float(self.points.spread * 0.5 * np.linalg.norm(ends[:3] + ends[3:]))

    def forget(self) -> None:
        """Forget what earlier steps showed."""
        self._newest = None


class Contacts:
    """Contacts in a step from ``begin`` to ``time`` [s]. All methods are collective.

    Positions are (owned or more, 3) [m]. Obstacles are where they are at the step's end if nothing else is said: they
    get there first. What is known of positions and ways ends with the step: a resumed run does not have it.
    """

    def __init__(self, near: NearPairs, begin: float, time: float):
        self.begin, self.time = begin, time
        self.near, self.comm, self.points, self.law = near, near.comm, near.points, near.law
        self.barrier, self.owned, self.obstacles = near.barrier, near.owned, near.points.obstacles
        self._moments: list[ContactsAt] = []
        self._ways: list[Way] = []

    def find(self, q: Positions, time: float | None = None) -> ContactsAt:
        """Return the contacts at positions q, and a time [s] if not that of the step's end."""
        q, time = q[: self.owned], self.time if time is None else time
        pairs = self.near.around(q, time)
        bound = self.near.moved(q, time, pairs)
        if bound < pairs.clear:
            return ContactsAt(q, time)
        for moment in self._moments:
            if self.same(moment.time, time) and self.comm.allreduce(bool(np.array_equal(q, moment.q)), MPI.LAND):
                return moment
        points = self.points(q, time)
        near = self._pairs_near(q, time, points, pairs, bound)
        contacts = self.barrier.contacts(near, points) if self.barrier else None
        count = self.comm.bcast(sum(map(len, contacts or ())))
        self._moments = [ContactsAt(q.copy(), time, count, points, contacts), *self._moments[: REMEMBERED - 1]]
        return self._moments[0]

    def _pairs_near(
        self, q: Positions, time: float, points: Positions, pairs: Pairs, bound: float
    ) -> "ipctk.Candidates | None":
        """Return the pairs that may be near at q, besides those in creases, on rank 0.

        bound : no point is farther from where ``pairs`` were looked for [m]
        """
        if bound < pairs.apart:
            return None
        if bound <= pairs.reach or self._serve(pairs, points):
            return pairs.candidates
        for way in self._ways if self.same(time, self.time) else ():
            share = self._share_of(way, q)
            near = way.sweep.pairs_at(share) if way.sweep and share is not None else None
            if share is not None and self.comm.bcast(near is not None):
                return near
        return self.near.look(q, time, FARTHEST * self.near.edge).candidates

    def same(self, begin: float, end: float) -> bool:
        """Return whether obstacles are at one time [s] where they are at another."""
        return not self.obstacles.moves(begin, end)

    def _share_of(self, way: Way, q: Positions) -> float | None:
        """Return the share of a way that positions q are at; None where they are not on it."""
        gone = q - way.q
        share = self.comm.allreduce(float(np.vdot(gone, way.moved))) / way.square if way.square else 0.0
        aside = self.points.spread * float(np.abs(gone - share * way.moved).max(initial=0.0))
        near = self.comm.allreduce(aside, MPI.MAX) <= ASIDE * self.law.distance / np.sqrt(3)
        return share if near and -ASIDE < share < 1 + ASIDE else None

    def _serve(self, pairs: Pairs, points: Positions) -> bool:
        """Return whether points S (p, 3) are within the pairs' reach, by their own moves."""
        serve = True
        if self.barrier:
            moved = points - pairs.points
            moved -= 0.5 * (moved.max(axis=0) + moved.min(axis=0))
            serve = bool((moved**2).sum(axis=1).max() <= pairs.reach**2)
        return bool(self.comm.bcast(serve))

    def touch(self, q: Positions, time: float) -> Touch:
        """Return what there is of contacts at q and a time [s]."""
        moment = self.find(q, time)
        touch = Touch()
        if self.barrier and moment.contacts is not None and moment.points is not None and moment.count:
            least = self.barrier.least(moment.contacts, moment.points)
            touch = Touch(moment.count, least, energy_of(self.barrier.pushing(moment.contacts), moment.points))
        of_all: Touch = self.comm.bcast(touch)
        return of_all

    def free_share(self, q: Positions, end: Positions, with_obstacles: bool = False) -> float:
        """Return the share, up to 1, of the straight way from q to ``end`` that no two triangles meet on.

        with_obstacles : these go from where they are when the step begins
        """
        begin = self.begin if with_obstacles else self.time
        q, end = q[: self.owned], end[: self.owned]
        pairs = self.near.around(q, begin)
        farthest = max(self.near.moved(q, begin, pairs), self.near.moved(end, self.time, pairs))
        if farthest < pairs.clear:
            return 1.0
        start, moved, share = self.points(q, begin), self.points.moved(end - q), 1.0
        if len(moved) and self.obstacles.total:
            moved[self.points.bodies :] = self.obstacles.way(begin, self.time)
        if self.barrier and farthest < pairs.apart:
            share = self.barrier.free_share_in_creases(start, moved)
        elif farthest > pairs.reach:
            share = self._swept(q, end, start, moved)
            if not self.same(begin, self.time):
                self._ways.pop(0)  # of no position on it are obstacles where they are at the step's end
        elif self.barrier and pairs.candidates is not None:
            share = self.barrier.free_share(start, moved, pairs.candidates)
        return float(self.comm.bcast(share))

    def _swept(self, q: Positions, end: Positions, start: Positions, moved: Rows) -> float:
        """Return the free share of a way that no known pairs serve for; those on it are kept."""
        share, sweep = 1.0, None
        if self.barrier:
            share, sweep = self.barrier.sweep(start, moved, ASIDE * self.law.distance)
        way = end - q
        square = self.comm.allreduce(float(np.vdot(way, way)))
        self._ways = [Way(q.copy(), way, square, sweep), *self._ways[: REMEMBERED - 1]]
        return share


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
