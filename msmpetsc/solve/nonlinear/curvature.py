"""Whether a step has come to a minimum of g: the lowest curvature of its true Hessian H = M + t^2 (Hessian of E).

F = 0 on a saddle, too, and a symmetric start stays on it. Where no spring or cell is compressed enough, H is
positive definite for certain, which one pass over them tells.
Elsewhere the load factor nu may say so, the greatest with H v = (1 - nu) H+ v, H+ the projected Hessian, which has
nothing negative and all of M: no eigenvalue of M^(-1) H is below 1 - nu. It is 1 where a body buckles, and grows as
what presses the body does (linear buckling analysis), so that one that was found serves for many steps. Where it is not
small the lowest eigenvalue of M^(-1) H is looked for: at length when the body is compressed anew or more than it was,
or something showed a negative curvature; at all other steps the mode found last is followed in a few iterations, with
multigrid only where its curvature changed.

Both are found by locally optimal conjugate gradients on a block of directions, preconditioned as the step is (Knyazev
2001, Toward the optimal preconditioned eigensolver, Algorithm 5.1); with Jacobi's a single direction was seen to settle
on the third.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import ClassVar, NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Floats, Positions, Rows, greatest, like, to_host
from msmpetsc.checkpoint import ANY, Checkpoint, Range
from msmpetsc.solve.linear.operators import TrueHessian
from msmpetsc.solve.nonlinear.functional import StepFunctional
from msmpetsc.solve.nonlinear.preconditioning import StepPreconditioner

MOST = 100  # iterations of a long search
SETTLED = (
    0.95  # of the curvature when half as many iterations were done: there is no lower one to come
)
SHARPENED = 1.1  # times a negative curvature two iterations ago: further ones lead down no steeper
MORE = 1.25  # times the compression of the last long search, or its mode's curvature: another mode may be lowest
ALIKE = 0.9  # of the lowest curvature: directions that lead down as well
TINY = np.finfo(float).tiny
DEPENDENT = 1e-10  # eigenvalue of the Gram matrix of unit directions: one of them is none; a compression that is none

Block = tuple[
    Rows, ...
]  # directions (k, n), what H makes of them, and what M or the projected Hessian does
Act = Callable[[None, PETSc.Vec, PETSc.Vec], None]


class Alarm(IntEnum):
    """Where something has shown a negative curvature."""

    NOWHERE = 0
    ON_THE_WAY = 1  # at an iterate that the step has left
    HERE = 2


class SearchEffort(NamedTuple):
    """block: directions of a long search; least: its iterations where it finds nothing; followed:
    iterations of a short one, of two directions."""

    block: int
    least: int
    followed: int


EFFORT = SearchEffort(4, 12, 2)
# With multigrid smooth modes come at once. But not where something is alarming: one bent by 270 degrees had a lowest
# curvature of 0.04, and seemed to have 0.35.
UNIFORM_EFFORT = SearchEffort(2, 3, 1)
UNCHANGED = 0.1  # of its curvature: a mode that is followed is taken as it is
LIGHT = 0.5  # load factor: up to there no mode need be known
UNSEEN = 1.2  # times the load factor that a few iterations find, which is no more than the true one
GROWN = 4.0  # times the compression that it was found at: so far a body is taken to be loaded alike
NEGLIGIBLE = 0.3  # of the greatest compression: nodes of less do not say how it has grown


@dataclass(frozen=True)
class Compressed:
    """The greatest and the sum, over the free nodes of all ranks, of t^2 concavity / m."""

    greatest: float = 0.0
    total: float = 0.0


@dataclass(frozen=True)
class Compression(Compressed):
    """Compression of a body at some positions.

    inertia : M is part of H, which outweighs what is not positive in the rest
    ratios  : t^2 concavity / m (m,) of this rank's free nodes
    """

    inertia: bool = True
    ratios: Floats = field(default_factory=lambda: np.empty(0))

    @property
    def least_curvature(self) -> float:
        """No eigenvalue of M^(-1) H is less; 0 where M does not outweigh all that is negative for certain."""
        return max(1 - self.greatest, 0.0) if self.inertia else 0.0


NONE = Compression()


class LowestCurvature:
    """Looks for directions of negative curvature of a step's Hessian. All methods but properties are collective.

    preconditioner : of the step's linear solves, or multigrid for a long search
    """

    state: ClassVar[dict[str, Range]] = {
        "searched": ANY,
        "value": ANY,
        "knows_mode": (0, 1),
        "load": ANY,
    }

    def __init__(
        self, functional: StepFunctional, hessian: TrueHessian, preconditioner: StepPreconditioner
    ):
        self.functional, self.hessian, self.preconditioner = functional, hessian, preconditioner
        self.comm, self.unknowns, self.memory = (
            functional.comm,
            functional.unknowns,
            functional.memory,
        )
        self.its = 0  # of all searches so far
        self.products = 0  # of them with H, and at multigrid's finest level
        self.searched = Compressed()  # the compression that the last long search was at
        self.mode: Floats | None = None  # the lowest known (n,), of unit length in the norm of M
        self.value = 0.0  # its curvature when it was found
        self.knows_mode = False  # in the last checkpoint
        self.load = np.inf  # load factor found last; infinite where none was
        self.loads = np.zeros_like(
            functional.lattice.mass[self.unknowns.free]
        )  # compression (m,) that it was found at
        self.load_mode: Floats | None = None  # and its mode (n,)
        self.vectors = [self.unknowns.create_vector() for _ in range(2)]
        self.rigid: Rows | None = None  # motions (6, n) that are left out

    @property
    def effort(self) -> SearchEffort:
        """Effort that a search takes with this preconditioner."""
        return UNIFORM_EFFORT if self.preconditioner.is_uniform else EFFORT

    def compression(self, q: Positions) -> Compression:
        """Compression at positions q (l, 3) [m] in the functional's problem."""
        functional, free = self.functional, self.unknowns.free
        elasticity = functional.elasticity
        concavity = elasticity.concavity(q)[free]
        if functional.surface:
            concavity = concavity + functional.surface.concavity(q)[free]
        ratios = functional.t2 * concavity / functional.lattice.mass[free]
        most, sums = zip(*self.comm.allgather((greatest(ratios), float(ratios.sum()))), strict=True)
        return Compression(max(most), sum(sums), not self.unknowns.static, ratios)

    def lowest(
        self, q: Positions, compression: Compression, alarm: Alarm, hint: PETSc.Vec | None
    ) -> tuple[float, Floats | None]:
        """Lowest eigenvalue of M^(-1) H that a search comes to, and a direction (n,) of about that curvature.

        Or a positive number that it is no less than, and None, where the load factor is small.

        q       : positions (l, 3) [m] that H was linearised at last
        hint    : a direction that may have part in it
        """
        products = self.hessian.products + self.preconditioner.products
        is_known = not (alarm or self.unknowns.static)
        least = 1 - self._load(q, compression.ratios) if is_known else 0.0
        found = None if least >= 1 - LIGHT else self._lowest(q, compression, alarm, hint)
        self.products += self.hessian.products + self.preconditioner.products - products
        if found is None:
            self.searched = Compressed()  # so that a body that is loaded more has a long search
            return least, None
        values, modes = found
        if not np.isfinite(values[0]):  # springs of no length: from a cusp any way leads down
            self.mode = None
            return -np.inf, self._random(1)[0]
        self.mode, self.value = modes[0].copy(), float(values[0])
        if values[0] < 0:
            # A random direction's projection on all that lead down as well: where a body may buckle to many sides, it
            # goes the same way on any ranks, no matter which of them rounding has made the first.
            down = modes[: int((values <= ALIKE * values[0]).sum())]
            parts = self.comm.allreduce(to_host((down * self.functional.mass) @ self._random(1)[0]))
            return values[0], like(down, parts / max(np.linalg.norm(parts), TINY)) @ down
        return values[0], self.mode

    def _lowest(
        self, q: Positions, compression: Compression, alarm: Alarm, hint: PETSc.Vec | None
    ) -> tuple[Floats, Rows]:
        """The lowest curvatures (k,) and their modes (k, n), followed or searched for at length."""
        found, before = None, self.searched
        more = (
            compression.greatest > MORE * before.greatest or compression.total > MORE * before.total
        )
        if not (alarm or more):  # in which case modes may have come
            found = self._followed()
        if found is None:
            # What was doubtful is so in the next step, too
            self.searched = (
                Compressed() if alarm else Compressed(compression.greatest, compression.total)
            )
            with self.preconditioner.searching(q, self.functional.problem.contact):
                found = self._search_at_length(
                    q, hint, EFFORT if alarm is Alarm.HERE else self.effort
                )
        return found

    def _load(self, q: Positions, ratios: Floats) -> float:
        """The load factor at positions q (l, 3) [m], at the most: as far as the body is loaded as it was when that was
        found, it grows as the compression does."""
        floor = NEGLIGIBLE * max(self.comm.allreduce(greatest(self.loads), MPI.MAX), DEPENDENT)
        growth = self.comm.allreduce(greatest(ratios / np.maximum(self.loads, floor)), MPI.MAX)
        load: float = UNSEEN * self.load * growth
        is_heavy = (
            MORE * UNSEEN * self.load > LIGHT
        )  # so nearly that a search would soon be due again
        if not np.isfinite(load) or (not is_heavy and (growth > GROWN or load > LIGHT)):
            with self.preconditioner.searching(q, self.functional.problem.contact):
                self.load = self._load_factor(q) if self.preconditioner.is_uniform else np.inf
            self.loads, load = ratios, UNSEEN * self.load
        return load

    def _load_factor(self, q: Positions) -> float:
        """The greatest nu with H v = (1 - nu) H+ v, H+ the projected Hessian, found by a few iterations."""
        functional, hessian = self.functional, self.hessian
        projected = TrueHessian(
            self.unknowns, functional.elasticity, functional.time_step, hessian.contact
        )
        projected.linearise(q, functional.problem.contact, True)
        known = [] if self.load_mode is None else [self.load_mode[None]]
        start = np.concatenate([*known, self._random(2 - len(known))])
        values, modes = self._iterate(
            start, 2, MOST, UNIFORM_EFFORT.least - len(known), projected.mult
        )
        self.load_mode = modes[0].copy()
        hessian.products += projected.products
        return 1 - float(values[0])

    def _followed(self) -> tuple[Floats, Rows] | None:
        """Lowest curvatures, and their modes, near the mode found last. None where none is known, or where it has
        stiffened so much that another may be the lowest now: one of 0.29 hid behind one that went from 0.87 to 1.57."""
        if self.mode is None:
            return None
        its = self.effort.followed
        values, modes = self._iterate(self.mode[None], 1, 0, 0)
        if abs(values[0] - self.value) <= UNCHANGED * self.value:
            # As it was, so that slow changes add up
            return np.array([self.value]), modes
        values, modes = self._iterate(
            np.concatenate([self.mode[None], self._random(1)]), 2, its, its
        )
        return None if values[0] > MORE * self.value else (values, modes)

    def _search_at_length(
        self, q: Positions, hint: PETSc.Vec | None, effort: SearchEffort
    ) -> tuple[Floats, Rows]:
        """Search from something of each mode, for near a mode that is known a lower one comes up
        late, and without rigid motions, for their curvature mostly is about 1, which would hide a
        lower one as long; then from the best of all of them."""
        is_uniform = effort is UNIFORM_EFFORT
        start = self._random(effort.block - (is_uniform and self.mode is not None))
        if hint is not None:
            start[0] += self._unit(self.memory.read(hint)[None])[0]
        known = [] if self.mode is None else [self.mode[None]]
        self.rigid = self._rigid_motions(q)
        if self.rigid is None and is_uniform:  # nothing hides a mode, nor is any slow to come
            return self._iterate(np.concatenate([start, *known]), effort.block, MOST, effort.least)
        _, modes = self._iterate(self._without_rigid(start), effort.block, MOST, effort.least)
        rigid, self.rigid = [] if self.rigid is None else [self.rigid], None
        return self._iterate(
            np.concatenate([modes, *known, *rigid]), effort.block, MOST, effort.least // 2
        )

    def _random(self, count: int) -> Rows:
        """Something of each mode (count, n), the same for any number of ranks, little of the stiff ones."""
        return self._unit(self._of_each(self.preconditioner.apply, self.functional.noise(count)))

    def _iterate(
        self, start: Rows, block: int, most: int, least: int, weigh: Act | None = None
    ) -> tuple[Floats, Rows]:
        """The lowest eigenvalues (k,), k <= block, that the iterations come to from directions (l,
        n), and theirs (k, n). They are of W^(-1) H, W what ``weigh`` applies, M if None."""
        size = min(block, len(start))
        values, (x, last) = self._ritz(self._block(start, weigh), size)
        size, lowest = len(values), [values[0]]  # fewer than wanted where the body has no more
        for its in range(1, most + 1):
            residuals = x[1] - like(start, values)[:, None] * x[2]
            sizes = np.array([greatest(np.abs(residual)) for residual in residuals])
            self.comm.Allreduce(MPI.IN_PLACE, sizes, MPI.MAX)
            residuals /= like(
                residuals, np.maximum(sizes, TINY)[:, None]
            )  # so that float32 holds them
            w = self._unit(self._without_rigid(self._of_each(self.preconditioner.apply, residuals)))
            blocks = [x, self._block(w, weigh), *([] if last is None else [last])]
            values, (x, last) = self._ritz(
                tuple(np.concatenate(parts) for parts in zip(*blocks, strict=True)), size
            )
            lowest.append(values[0])
            self.its += len(w)
            if lowest[-1] < 0:
                if its >= 2 and lowest[-1] > SHARPENED * lowest[-3]:
                    break
            elif its >= least and lowest[-1] > SETTLED * lowest[its // 2]:
                break
        return values, x[0]

    def _block(self, directions: Rows, weigh: Act | None) -> Block:
        weighed = (
            directions * self.functional.mass if weigh is None else self._of_each(weigh, directions)
        )
        return directions, self._of_each(self.hessian.mult, directions), weighed

    def _ritz(self, block: Block, size: int) -> tuple[Floats, tuple[Block, Block | None]]:
        """The lowest eigenvalues in the span of a block, ascending (size,); their directions, of unit length, and of
        each what it has of all but the first ``size`` directions: how it moved (Rayleigh and Ritz)."""
        span, products, weighed = block
        grams = self.comm.allreduce(
            np.stack([to_host(span @ products.T), to_host(span @ weighed.T)])
        )
        lengths = np.sqrt(np.maximum(grams[1].diagonal(), TINY))
        grams = grams / lengths / lengths[:, None]
        sizes, parts = np.linalg.eigh(0.5 * (grams[1] + grams[1].T))
        kept = sizes > DEPENDENT * max(sizes[-1], TINY)
        parts = parts[:, kept] / np.sqrt(sizes[kept])
        values, turns = np.linalg.eigh(parts.T @ (0.5 * (grams[0] + grams[0].T)) @ parts)
        parts = (parts @ turns)[:, :size].T / lengths
        on_device = like(span, parts)
        best = tuple(on_device @ rows for rows in block)
        if len(span) <= size:
            return values[:size], (best, None)
        rest = like(span, parts[:, size:])
        return values[:size], (best, tuple(rest @ rows[size:] for rows in block))

    def _rigid_motions(self, q: Positions) -> Rows | None:
        """Translations and rotations of a free body at positions q (l, 3) [m], (6, n) orthonormal
        in M; None if nodes are held."""
        if self.unknowns.total < self.functional.lattice.table.total:
            return None
        columns = q[self.unknowns.free].T
        motions = np.zeros((6, *columns.shape), like=columns)
        for c in range(3):
            motions[c, c] = 1.0
            motions[3 + c, (c + 1) % 3], motions[3 + c, (c + 2) % 3] = (
                -columns[(c + 2) % 3],
                columns[(c + 1) % 3],
            )
        motions = motions.reshape(6, -1)
        for _ in range(2):  # once more, for what the first left of rounding
            sizes, parts = np.linalg.eigh(
                self.comm.allreduce(to_host((motions * self.functional.mass) @ motions.T))
            )
            kept = sizes > DEPENDENT * sizes[-1]
            motions = like(motions, (parts[:, kept] / np.sqrt(sizes[kept])).T) @ motions
        return motions

    def _without_rigid(self, directions: Rows) -> Rows:
        if self.rigid is None:
            return directions
        parts = self.comm.allreduce(to_host((directions * self.functional.mass) @ self.rigid.T))
        return directions - like(directions, parts) @ self.rigid

    def _of_each(self, act: Act, directions: Rows) -> Rows:
        source, product = self.vectors
        results = np.empty_like(directions)
        for direction, result in zip(directions, results, strict=True):
            self.memory.write(source)[:] = direction
            act(None, source, product)
            result[:] = self.memory.read(product)
        return results

    def _unit(self, directions: Rows) -> Rows:
        """Directions scaled to unit length in the norm of M; those of no length stay so."""
        squares: Floats = self.comm.allreduce(to_host(directions**2 @ self.functional.mass))
        lengths: Rows = like(directions, np.maximum(np.sqrt(squares), TINY))[:, None]
        return directions / lengths

    def save(self, checkpoint: Checkpoint) -> None:
        """Store the mode and what was searched: another long search at each checkpoint would cost a tenth of a run."""
        rows = np.zeros((self.functional.lattice.owned, 3), like=self.functional.lattice.nodes)
        self.knows_mode = self.mode is not None
        if self.mode is not None:
            rows[self.unknowns.free] = self.mode.reshape(3, -1).T
        loads = np.zeros_like(self.functional.lattice.mass)
        loads[self.unknowns.free] = self.loads
        checkpoint.keep({"lowest_mode": rows, "loads": loads})
        checkpoint.keep_counts(self)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint."""
        checkpoint.restore_counts(self)
        if self.knows_mode:
            rows = like(self.functional.mass, checkpoint.row("lowest_mode"))
            self.mode = rows[self.unknowns.free].T.ravel()
        self.loads = like(self.functional.mass, checkpoint.row("loads"))[self.unknowns.free]

    def forget(self, modes: bool = True) -> None:
        """Forget what a checkpoint does not hold; ``modes``: all else, too."""
        self.load_mode = None
        if modes:
            self.searched, self.mode, self.load = Compressed(), None, np.inf

    def destroy(self) -> None:
        for vector in self.vectors:
            vector.destroy()
