"""Contacts of a surface with itself and with obstacles, wherever they are: looked for as rarely as can be.

Pairs of its parts that may meet are looked for around positions, and again where a point has moved farther than was
allowed for then; a common translation is no such move. Where none of them can come near, positions of nodes tell that
without a single point's being computed; elsewhere points tell, for light nodes around a body swing much farther. Pairs
outlive a step (``NearPairs``); contacts at positions are known for as long as it lasts (``Contacts``). Where few points
touch, a step asks for the pairs around these alone, and for all of them once, where it has come to.
"""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Mask, Positions, Rows
from msmpetsc.comm import log, on_root
from msmpetsc.contact.surface.barrier import PIECE, Barrier, BarrierLaw, ContactSets, PairSets
from msmpetsc.contact.surface.creases import NEAREST
from msmpetsc.contact.surface.points import SurfacePoints
from msmpetsc.geometry.surface import Surface

REMEMBERED = 3  # positions whose contacts are kept, and pairs: where a line search starts, and where it tries
FARTHEST = 0.05  # edges that a point may move before pairs are looked for anew: with 0.25 there are 4 times the pairs
LEAST = 0.02  # edges that it may always move: fewer pairs are no faster
AHEAD = 2.0  # times the move of a step in which nothing touched
FEW = 0.01  # of all points: where more touch, to solve once more costs as much as to look for all pairs each time
SAME = 1e-9  # of the energy of contacts, that two sums of it may differ by
TINY = np.finfo(float).tiny


@dataclass(frozen=True)
class CollisionSurface:
    """The surface that meets itself or obstacles.

    surface      : on rank 0, triangles that cut others taken out, and the obstacles'; None on the others
    points       : its points as the nodes carry them
    meets_itself : or obstacles alone
    parts        : name of each body and obstacle as a scene has it, and the number of its points; on rank 0
    """

    surface: Surface | None
    points: SurfacePoints
    law: BarrierLaw
    meets_itself: bool
    parts: list[tuple[str, int]]

    def name_of(self, point: int) -> str:
        """Return the name of the body or the obstacle that has the point of this number."""
        ends = np.cumsum([count for _, count in self.parts])
        return self.parts[int(np.searchsorted(ends, point, side="right"))][0]


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

    time         : [s], at which obstacles are there as they are
    clear        : no more than reach [m]; no pair comes near enough to count while no point moves farther
    points, sets : S there (p, 3) [m] and the pairs, on rank 0
    moved        : the ways (p, 3) [m], on rank 0; None where there are none
    """

    q: Positions
    time: float
    reach: float
    clear: float
    points: Positions
    sets: PairSets
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
        self.name_of = collision.name_of
        self.owned, surface = collision.points.weights.shape[1], collision.surface
        self.barrier: Barrier | None = on_root(
            comm, lambda: _barrier(surface, collision) if surface else None
        )
        self.edge: float = comm.bcast(self.barrier.edge if self.barrier else 0.0)
        self._known: list[Pairs] = []  # the newest first

    def around(self, q: Positions, time: float) -> Pairs:
        """Return the newest pairs; those at q if there are none yet."""
        return self._known[0] if self._known else self.look(q, time, self.law.distance)

    def serving(self, *places: Positions) -> Pairs | None:
        """Return the newest pairs within whose reach all of these places of points S (p, 3) are, by their own moves."""
        known = enumerate(self._known if self.barrier else ())
        number: int | None = self.comm.bcast(
            next((i for i, pairs in known if all(map(pairs.serve, places))), None)
        )
        if number is None:
            return None
        self._known.insert(0, self._known.pop(number))
        return self._known[0]

    def look(self, q: Positions, time: float, reach: float, moved: Rows | None = None) -> Pairs:
        """Look for pairs at q, or on the way of the points from there by ``moved`` (p, 3) [m]."""
        points, reach = (
            self.points(q, time),
            min(max(reach, LEAST * self.edge), FARTHEST * self.edge),
        )
        sets: PairSets = ()
        clear = 0.0
        if self.barrier:
            sets = self.barrier.candidates(points, reach, moved)
            clear = self.barrier.clear_reach(sets, points, reach) if moved is None else 0.0
        newest = Pairs(
            q[: self.owned].copy(), time, reach, self.comm.bcast(clear), points, sets, moved
        )
        self._known = [newest, *self._known[: REMEMBERED - 1]]
        return newest

    def farthest(self, end: Positions, start: Positions, time: float, begin: float) -> float:
        """Return no less than how far any point goes when nodes go from start to end, but for a translation [m]."""
        moved = end[: self.owned] - start[: self.owned]
        if self.points.obstacles.total:
            moved = np.vstack([moved, self.points.obstacles.way(begin, time)])
        along = np.ascontiguousarray(
            moved.T
        )  # along the last axis numpy takes a twentieth of the time
        ends = [
            np.fmax.reduce(along, axis=1, initial=-np.inf),
            -np.fmin.reduce(along, axis=1, initial=np.inf),
        ]
        ends = np.concatenate(ends)
        self.comm.Allreduce(
            MPI.IN_PLACE, ends, MPI.MAX
        )  # the greatest along the axes and against them
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

    before    : contacts of the step before, whose end is known
    is_narrow : those pairs alone are asked for that are around some contacts
    apart     : and there are no contacts: the surface need not be asked for
    """

    def __init__(
        self, near: NearPairs, begin: float, time: float, before: "Contacts | None" = None
    ):
        self.begin, self.time = begin, time
        self.near, self.comm, self.points, self.law = near, near.comm, near.points, near.law
        self.barrier, self.owned, self.obstacles = near.barrier, near.owned, near.points.obstacles
        self.is_narrow = self.apart = False
        self._around: PairSets = ()  # on rank 0
        self._touched: Mask | None = None  # (p,) the points that these are around
        self._moments: list[ContactsAt] = before._moments if before and not before.is_narrow else []
        # q, time and points of some positions
        self._points: list[tuple[Positions, float, Positions]] = before._points if before else []

    def find(
        self,
        q: Positions,
        time: float | None = None,
        with_points: bool = False,
        base: Positions | None = None,
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
        bound = self.near.farthest(q, pairs.q, time, pairs.time)
        if bound < pairs.clear and not with_points:
            return ContactsAt(q, time, 0, np.empty((0, 3)), ())
        points = self.points_at(q, time)
        if bound > pairs.reach and not self.is_narrow:
            pairs = self.near.serving(points) or self._look(q, time, points, base)
        sets = self._around if self.is_narrow else pairs.sets
        contacts = self.barrier.contacts(sets, points) if self.barrier else ()
        count = self.comm.bcast(sum(map(len, contacts)))
        self._moments = [
            ContactsAt(q.copy(), time, count, points, contacts),
            *self._moments[: REMEMBERED - 1],
        ]
        return self._moments[0]

    def narrow(self, q: Positions, time: float) -> bool:
        """Ask from now on for the pairs alone that are around contacts at q and a time [s], and around those before, or
        for all if these touch at too many points; return which."""
        moment, touched = self.find(q, time), None
        if self.barrier and moment.count:
            touched = self.barrier.gradient(moment.contacts, moment.points).any(axis=1)
            touched = touched if self._touched is None else touched | self._touched
        self.is_narrow = self.comm.bcast(touched is None or touched.mean() < FEW)
        self._moments, self._touched, self.apart = (
            [moment],
            touched,
            self.is_narrow and moment.count == 0,
        )
        points = self.points_at(q, self.time) if self.is_narrow and not self.apart else None
        if self.barrier and points is not None and touched is not None:
            self._around = self.barrier.around(touched, points, FARTHEST * self.near.edge)
        return self.is_narrow

    def widen(self) -> None:
        """Ask for all pairs."""
        self.is_narrow, self.apart, self._moments = False, False, []

    @contextmanager
    def cushioned(self, distance: float) -> Iterator[None]:
        """Let obstacles push bodies from a farther ``distance`` [m], too; all pairs are asked for from now on."""
        with self.barrier.cushioned(distance) if self.barrier else nullcontext():
            self._look_anew()
            try:
                yield
            finally:
                self._look_anew()

    def _look_anew(self) -> None:
        self.widen()
        self.near.forget()

    def after_way(self, q: Positions, x: Positions, left_out: float) -> tuple[bool, bool]:
        """Return whether the way of a narrow step from q to x is free, and whether x is right.

        At a right x the energy of all pairs is within ``left_out`` [J] of the known pairs' energy.

        From then on all pairs are asked for; where the way is free and x is not right, still those around contacts.
        """
        known = Touch() if self.apart else self.touch(x, self.time)
        self.widen()
        pairs, bound = self._bound(q, self.begin, x)
        ahead = AHEAD * self.near.farthest(x, q, self.time, self.begin)
        if (
            bound > pairs.reach and ahead <= FARTHEST * self.near.edge
        ):  # so that the next steps need no look
            self.near.look(x, self.time, ahead)
        self.find(x, base=q)
        found, free = self.touch(x, self.time), self.free_share(q, x, self.begin) == 1.0
        is_right = free and abs(found.energy - known.energy) <= SAME * known.energy + left_out
        if free and not is_right:
            self.narrow(x, self.time)
        return free, is_right

    def _look(self, q: Positions, time: float, points: Positions, base: Positions | None) -> Pairs:
        """Look for pairs at q, whose points are S (p, 3) [m], and on the way there from base, if that is not long."""
        moved = None if base is None else self.points_at(base, time) - points
        if self.comm.bcast(
            moved is not None and len(moved) > 0 and farthest(moved) > PIECE * self.near.edge
        ):
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

    def nearest(self, q: Positions) -> str:
        """Return in words which two parts of the surface are nearest at q, and where."""
        moment, words = self.find(q, with_points=True), ""
        if self.barrier:
            points = self.barrier.nearest(moment.contacts, moment.points)
            names = dict.fromkeys(self.near.name_of(point) for point in points)
            place = ", ".join(f"{x:.4g}" for x in moment.points[points].mean(axis=0))
            words = (
                f"{' and '.join(names)} meet at ({place}) m"
                if len(points)
                else "parts of the surface meet"
            )
        in_words: str = self.comm.bcast(words)
        return in_words

    def _bound(self, q: Positions, begin: float, end: Positions) -> tuple[Pairs, float]:
        """Return the newest pairs, and no less than how far points are from them on a way from q at ``begin`` [s]."""
        pairs = self.near.around(q, begin)
        places = (q, begin), (end, self.time)
        return pairs, max(self.near.farthest(at, pairs.q, time, pairs.time) for at, time in places)

    def free_share(self, q: Positions, end: Positions, begin: float | None = None) -> float:
        """Return the share, up to 1, of the straight way from q to ``end`` on which no two triangles meet.

        begin : obstacles go from their place at this time [s] to their present place; None: they stay
        """
        begin = self.time if begin is None else begin
        pairs, bound = self._bound(q, begin, end)
        if bound < pairs.clear:
            return 1.0
        start = self.points_at(q, begin)
        moved = self.points_at(end, self.time) - start
        way = self.comm.bcast(farthest(moved) if self.barrier else 0.0)
        if 2 * way < self.law.distance and 2 * way < self._clearance(q, begin):
            return 1.0
        sets = self._around
        if not self.is_narrow:
            # pairs that serve at its end alone say nothing of what is passed on the way there
            serving = self.near.serving(start, start + moved)
            if not serving and way > PIECE * self.near.edge:
                return float(
                    self.comm.bcast(self.barrier.sweep(start, moved) if self.barrier else 1.0)
                )
            sets = (serving or self.near.look(q, begin, LEAST * self.near.edge, moved)).sets
        return float(
            self.comm.bcast(self.barrier.free_share(start, moved, sets) if self.barrier else 1.0)
        )

    def _clearance(self, q: Positions, time: float) -> float:
        """Return the least distance [m] of any pair at q and a time [s], but no more than dhat."""
        moment, clearance = self.find(q, time, with_points=True), 0.0
        if self.barrier:
            sets = self._around if self.is_narrow else self.barrier.creases
            clearance = self.barrier.clearance(moment.contacts, sets, moment.points)
        return float(self.comm.bcast(clearance))


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
