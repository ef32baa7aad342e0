"""Contacts of a surface with itself, wherever the nodes are: looked for as rarely as can be.

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
    """The surface that meets itself.

    surface : on rank 0, triangles that cut others taken out; None on the others
    points  : its points as the nodes carry them
    """

    surface: Surface | None
    points: SurfacePoints
    law: BarrierLaw


@dataclass(frozen=True)
class Touch:
    """Contacts of one moment: their number, the least distance [m], NaN where there are none, and the energy [J]."""

    contacts: int = 0
    distance: float = np.nan
    energy: float = 0.0


@dataclass(frozen=True)
class Pairs:
    """Pairs that may meet while no point moves by more than ``reach`` [m] from q (owned, 3), but for a translation.

    apart              : no more than reach [m]; none of them comes near enough to count while no point moves farther
    clear              : no more than that [m]; nor does any pair in a crease, which is not among them
    points, candidates : S there (p, 3) [m] and the pairs, on rank 0
    """

    q: Positions
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
    """Contacts at positions q (owned, 3) [m].

    count    : their number
    points   : S (p, 3) [m], on rank 0; None on all where it was not needed
    contacts : on rank 0
    """

    q: Positions
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
        self.barrier: Barrier | None = on_root(comm, lambda: _barrier(surface, self.law) if surface else None)
        self.edge: float = comm.bcast(self.barrier.edge if self.barrier else 0.0)
        self._newest: Pairs | None = None

    def step(self, q: Positions, end: Positions) -> "Contacts":
        """Return the contacts of a step from q to about ``end``; pairs are looked for unless the known ones serve."""
        pairs = self._newest
        if not (pairs and max(self.moved(q, pairs), self.moved(end, pairs)) <= pairs.reach):
            self.look(q, AHEAD * self._farthest(end, q))
        return Contacts(self)

    def around(self, q: Positions) -> Pairs:
        """Return the newest pairs; those at q if there are none yet."""
        return self._newest or self.look(q, self.law.distance)

    def look(self, q: Positions, reach: float) -> Pairs:
        """Look for pairs at q."""
        points, reach = self.points(q), min(max(reach, self.law.distance), FARTHEST * self.edge)
        candidates, ways = None, (0.0, 0.0)
        if self.barrier:
            candidates = self.barrier.candidates(points, reach)
            ways = self.barrier.clear_reach(candidates, points, reach)
        apart, clear = self.comm.bcast(ways)
        self._newest = Pairs(q[: self.owned].copy(), reach, apart, clear, points, candidates)
        return self._newest

    def moved(self, q: Positions, pairs: Pairs) -> float:
        """Return no less than how far points at q are from where the pairs were looked for [m]."""
        return self._farthest(q, pairs.q)

    def _farthest(self, end: Positions, start: Positions) -> float:
        """Return no less than how far any point goes when nodes go from start to end, but for a translation [m]."""
        moved = end[: self.owned] - start[: self.owned]
        ends = np.concatenate([np.fmax.reduce(moved, initial=-np.inf), -np.fmin.reduce(moved, initial=np.inf)])
        self.comm.Allreduce(MPI.IN_PLACE, ends, MPI.MAX)  # the greatest along the axes and against them
        return float(self.points.spread * 0.5 * np.linalg.norm(ends[:3] + ends[3:]))

    def forget(self) -> None:
        """Forget what earlier steps showed."""
        self._newest = None


class Contacts:
    """Contacts in a step. All methods are collective; positions are (owned or more, 3) [m].

    What is found at positions and on ways is known for as long as the step lasts: a resumed run does not have it.
    """

    def __init__(self, near: NearPairs):
        self.near, self.comm, self.points, self.law = near, near.comm, near.points, near.law
        self.barrier, self.owned = near.barrier, near.owned
        self._moments: list[ContactsAt] = []
        self._ways: list[Way] = []

    def find(self, q: Positions) -> ContactsAt:
        """Return the contacts at positions q."""
        q = q[: self.owned]
        pairs = self.near.around(q)
        bound = self.near.moved(q, pairs)
        if bound < pairs.clear:
            return ContactsAt(q)
        for moment in self._moments:
            if self.comm.allreduce(bool(np.array_equal(q, moment.q)), MPI.LAND):
                return moment
        points = self.points(q)
        near = self._pairs_near(q, points, pairs, bound)
        contacts = self.barrier.contacts(near, points) if self.barrier else None
        count = self.comm.bcast(sum(map(len, contacts or ())))
        self._moments = [ContactsAt(q.copy(), count, points, contacts), *self._moments[: REMEMBERED - 1]]
        return self._moments[0]

    def _pairs_near(self, q: Positions, points: Positions, pairs: Pairs, bound: float) -> "ipctk.Candidates | None":
        """Return the pairs that may be near at q, besides those in creases, on rank 0.

        bound : no point is farther from where ``pairs`` were looked for [m]
        """
        if bound < pairs.apart:
            return None
        if bound <= pairs.reach or self._serve(pairs, points):
            return pairs.candidates
        for way in self._ways:
            share = self._share_of(way, q)
            near = way.sweep.pairs_at(share) if way.sweep and share is not None else None
            if share is not None and self.comm.bcast(near is not None):
                return near
        return self.near.look(q, FARTHEST * self.near.edge).candidates

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

    def touch(self, q: Positions) -> Touch:
        """Return what there is of contacts at q."""
        moment = self.find(q)
        touch = Touch()
        if self.barrier and moment.contacts is not None and moment.points is not None and moment.count:
            least = self.barrier.least(moment.contacts, moment.points)
            touch = Touch(moment.count, least, energy_of(self.barrier.pushing(moment.contacts), moment.points))
        of_all: Touch = self.comm.bcast(touch)
        return of_all

    def free_share(self, q: Positions, end: Positions) -> float:
        """Return the share, up to 1, of the straight way from q to ``end`` that no two triangles meet on."""
        q, end = q[: self.owned], end[: self.owned]
        pairs = self.near.around(q)
        farthest = max(self.near.moved(q, pairs), self.near.moved(end, pairs))
        if farthest < pairs.clear:
            return 1.0
        start, moved, share = self.points(q), self.points(end - q), 1.0
        if self.barrier and farthest < pairs.apart:
            share = self.barrier.free_share_in_creases(start, moved)
        elif farthest > pairs.reach:
            share = self._swept(q, end, start, moved)
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


def _barrier(surface: Surface, law: BarrierLaw) -> Barrier:
    barrier = Barrier(surface, law)
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
