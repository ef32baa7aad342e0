"""Candidate contact pairs of a surface, cached so that the broad phase runs rarely.

The broad phase finds candidate pairs at given positions. The pairs are valid until a point has
moved by more than a margin; a translation of all points does not count.

If few points touch, a step is narrow: it uses the candidates around these points, and all
candidates once, at its end.
"""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Positions, Rows
from msmpetsc.comm import log, on_root, reduced
from msmpetsc.contact.surface.barrier import Barrier, BarrierLaw, CandidateSets, ContactSets
from msmpetsc.contact.surface.continuous_collision import PIECE, collision_free_step
from msmpetsc.contact.surface.creases import NEAREST
from msmpetsc.contact.surface.points import SurfacePoints
from msmpetsc.geometry.surface import Surface

# Margin of candidate pairs: displacement of a point before a new broad phase, or in a
# narrow step [mean edges]; a smaller margin does not give fewer pairs, 0.25 gives four
# times as many
REACH = 0.02
# Share of points in contact from which second solves cost more than narrow steps save
# [-]
FEW = 0.01
# Energy of pairs that may be left out of a step [energy tolerance of the step]; leaving
# them out moves x by 0.01 of the error
LEFT_OUT = 1e-4
# Relative difference of two sums of contact energy that counts as rounding [-]
SAME_ENERGY = 1e-9


@dataclass(frozen=True)
class CollisionSurface:
    """Surface of bodies and obstacles in contact.

    surface      : surface of bodies without crossing triangles, then of obstacles, on rank 0; None
                   elsewhere
    points       : W, from positions of nodes to points of the surface
    meets_itself : False if bodies meet obstacles alone
    parts        : name and number of points of each body and obstacle, on rank 0
    """

    surface: Surface | None
    points: SurfacePoints
    law: BarrierLaw
    meets_itself: bool
    parts: list[tuple[str, int]]

    def name_of(self, point: int) -> str:
        """Return the name of the body or obstacle of a point."""
        ends = np.cumsum([count for _, count in self.parts])
        return self.parts[int(np.searchsorted(ends, point, side="right"))][0]


@dataclass(frozen=True)
class ContactSummary:
    """Number of contacts, least distance [m] (NaN without contact) and energy [J]."""

    contacts: int = 0
    distance: float = np.nan
    energy: float = 0.0


@dataclass(frozen=True)
class CandidatePairs:
    """Candidate pairs that are valid while points stay within a margin of their places or paths.

    A translation of all points does not count.

    margin : greatest displacement of a point [m]
    points : S (p, 3) [m] of the broad phase, on rank 0
    sets   : candidate pairs, on rank 0
    moved  : straight paths (p, 3) [m] of the points, on rank 0; None if points stay
    """

    margin: float
    points: Positions
    sets: CandidateSets
    moved: Rows | None = None

    def is_valid_at(self, points: Positions) -> bool:
        """Return whether points S (p, 3) [m] are within the margin, on rank 0."""
        gone = points - self.points
        if self.moved is not None:
            gone, path = gone - gone.mean(axis=0), self.moved - self.moved.mean(axis=0)
            square = max(np.vdot(path, path), np.finfo(float).tiny)
            gone -= np.clip(np.vdot(gone, path) / square, 0.0, 1.0) * path
        return farthest(gone) <= self.margin


@dataclass(frozen=True)
class ActivePairs:
    """Pairs that push at given positions and a time of obstacles.

    q      : (owned or more, 3) positions [m]
    time   : time [s] of the obstacles' places
    count  : number of pairs
    points : S (p, 3) [m], on rank 0; (0, 3) elsewhere
    sets   : the pairs, on rank 0
    """

    q: Positions
    time: float
    count: int
    points: Positions
    sets: ContactSets


class ContactSearch:
    """Search for contacts of the surface in a step from ``begin`` to ``time`` [s].

    All methods are collective. Positions are (owned or more, 3) [m]. Obstacles have their places at
    the end of the step unless another time is given. Candidate pairs outlive a step.

    barrier     : on rank 0
    edge        : mean length of the bodies' edges at rest [m]
    start       : pairs at the start of the last step; None before the first step
    end         : pairs at the end of the last step, or of its last solve; None before that solve
    is_narrow   : whether only candidates around known contacts are used
    is_left_out : whether the step is narrow without contacts, so that the surface is left out
    """

    def __init__(self, collision: CollisionSurface):
        self.points, self.law = collision.points, collision.law
        self.comm = comm = collision.points.comm
        self.name_of, self.obstacles = collision.name_of, collision.points.obstacles
        self.owned, surface = collision.points.weights.shape[1], collision.surface
        self.barrier: Barrier | None = on_root(
            comm, lambda: _barrier(surface, collision) if surface else None
        )
        self.edge: float = comm.bcast(self.barrier.edge if self.barrier else 0.0)
        self.begin = self.time = 0.0
        self.start: ActivePairs | None = None
        self.end: ActivePairs | None = None
        self.is_narrow = self.is_left_out = False
        # Candidates of a narrow step, on rank 0
        self._around: CandidateSets = ()
        # Candidates of the last broad phase
        self._known: CandidatePairs | None = None

    def begin_step(self, q: Positions, begin: float, time: float) -> ActivePairs:
        """Begin a step from q between two times [s], with all candidates. Return the pairs at q."""
        self.begin, self.time = begin, time
        self.widen()
        self.start, self.end = self.pairs_at(q, begin), None
        return self.start

    def pairs_at(self, q: Positions, time: float) -> ActivePairs:
        """Return the pairs at q and a time [s], known if the last step began or ended there."""
        for known in filter(None, (self.end, self.start)):
            is_known = known.q is q and not self.obstacles.moves(known.time, time)
            if reduced(self.comm, is_known, MPI.LAND):
                return known
        return self.find(q, time)

    def forget(self) -> None:
        """Forget all positions, so that the next step does not depend on earlier steps."""
        self.widen()
        self._known = self.start = self.end = None

    def _valid_at(self, *places: Positions) -> CandidatePairs | None:
        """Return the last candidates if they are valid at all ``places`` (p, 3) [m], or None."""
        known = self._known
        is_valid = bool(self.barrier and known and all(map(known.is_valid_at, places)))
        return known if self.comm.bcast(is_valid) else None

    def _broad_phase(self, points: Positions, moved: Rows | None = None) -> CandidatePairs:
        """Find and cache candidate pairs at points (p, 3) [m], or on their paths by ``moved``."""
        margin = REACH * self.edge
        sets = self.barrier.candidates(points, margin, moved) if self.barrier else ()
        self._known = CandidatePairs(margin, points, sets, moved)
        return self._known

    def find(self, q: Positions, time: float | None = None) -> ActivePairs:
        """Return the pairs that push at positions q.

        time : time [s] of obstacles; None for the end of the step
        """
        time = self.time if time is None else time
        points, sets = self.points(q, time), self._around
        if not self.is_narrow:
            sets = (self._valid_at(points) or self._broad_phase(points)).sets
        active = self.barrier.contacts(sets, points) if self.barrier else ()
        count: int = self.comm.bcast(sum(map(len, active)))
        return ActivePairs(q, time, count, points, active)

    def narrow(self, pairs: ActivePairs) -> None:
        """Use only candidates around the points of given pairs, unless too many points touch."""
        touched = self.pushes(pairs).any(axis=1)
        few = pairs.count == 0 or touched.sum() < FEW * len(touched)
        self.is_narrow = self.comm.bcast(bool(few))
        self.is_left_out = self.is_narrow and pairs.count == 0
        if self.is_narrow and not self.is_left_out:
            points = self.points(pairs.q, self.time)
            if self.barrier:
                self._around = self.barrier.around(touched, points, REACH * self.edge)

    def widen(self) -> None:
        """Use all candidates from now on."""
        self.is_narrow = self.is_left_out = False

    def settle(self, used: ActivePairs | None, x: Positions, tolerance: float) -> tuple[bool, bool]:
        """Return whether a solution x is right, and whether the path to x is free.

        A solution of a narrow step is right if the path is free, and if all pairs have nearly the
        energy of the pairs used. Afterwards the step uses all candidates.

        used      : pairs at x with which x was found; None if the surface was left out
        tolerance : energy [J]; if g / tau^2 is this close to its minimum, x meets the error
        """
        if not self.is_narrow:
            self.end = used
            return True, True
        assert self.start is not None
        energy = self.summary(used).energy if used else 0.0
        self.widen()
        free = self.collision_free_step(self.start.q, x, self.begin) == 1.0
        self.end = self.find(x)
        missing = abs(self.summary(self.end).energy - energy)
        return free and missing <= SAME_ENERGY * energy + LEFT_OUT * tolerance, free

    def pushes(self, pairs: ActivePairs) -> Rows:
        """Return the gradient (total, 3) [N] of the barrier on rank 0; (0, 3) elsewhere."""
        barrier = self.barrier
        return (
            barrier.gradient(pairs.sets, pairs.points) if barrier else np.zeros_like(pairs.points)
        )

    def summary(self, pairs: ActivePairs) -> ContactSummary:
        """Return number, least distance and energy of the pairs."""
        summary = ContactSummary()
        if self.barrier and pairs.count:
            at = pairs.sets, pairs.points
            summary = ContactSummary(pairs.count, self.barrier.least(*at), self.barrier.energy(*at))
        of_all: ContactSummary = self.comm.bcast(summary)
        return of_all

    def nearest(self, q: Positions) -> str:
        """Return a text that names the two nearest parts of the surface at q, and their place."""
        in_words: str = self.comm.bcast(self.in_words(self.find(q)))
        return in_words

    def in_words(self, pairs: ActivePairs) -> str:
        """Return a text that names the two nearest parts in contact, on rank 0; "" elsewhere."""
        if not self.barrier:
            return ""
        points = self.barrier.nearest(pairs.sets, pairs.points)
        if not len(points):
            return "parts of the surface meet"
        names = dict.fromkeys(self.name_of(point) for point in points)
        place = ", ".join(f"{x:.4g}" for x in pairs.points[points].mean(axis=0))
        return f"{' and '.join(names)} meet at ({place}) m"

    def collision_free_step(
        self, q: Positions, end: Positions, begin: float | None = None
    ) -> float:
        """Return the step length, at most 1, from q to ``end`` before two triangles meet.

        begin : time [s] from which obstacles move to their present places; None if they stay
        """
        begin = self.time if begin is None else begin
        start = self.points(q, begin)
        moved = self.points(end, self.time) - start
        sets: CandidateSets | None = self._around
        if not self.is_narrow:
            # Candidates must be valid at both ends of the path
            known = self._valid_at(start, start + moved)
            length = self.comm.bcast(farthest(moved) if self.barrier else 0.0)
            if not known and length <= PIECE * self.edge:
                known = self._broad_phase(start, moved)
            sets = known.sets if known else None
        share = collision_free_step(self.barrier, start, moved, sets) if self.barrier else 1.0
        return float(self.comm.bcast(share))


def farthest(moved: Rows) -> float:
    """Return the greatest displacement [m] of ``moved`` (p, 3) [m] from the middle of its range."""
    along = np.ascontiguousarray(moved.T)
    middle = 0.5 * (along.max(axis=1) + along.min(axis=1))
    return float(np.sqrt(((along - middle[:, None]) ** 2).sum(axis=0).max()))


def _barrier(surface: Surface, collision: CollisionSurface) -> Barrier:
    """Return the barrier of a surface. Warn of pairs that may cross."""
    law = collision.law
    barrier = Barrier(surface, law, collision.points.bodies, collision.meets_itself)
    if dropped := barrier.leave_out_neighbours(surface.points):
        log.warning(
            "self_contact: %d pairs of the surface's parts in creases all but touch at rest, "
            "nearer than %.3g m: they are left out, and may cross",
            dropped,
            NEAREST * law.distance,
        )
    return barrier
