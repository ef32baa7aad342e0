"""Lowest curvature of a step's true Hessian H = M + t^2 (Hessian of E).

F vanishes on a saddle of g, too, and a symmetric start never leaves the saddle. Three tests follow
each other until H is known to be positive definite or a direction of negative curvature is found:

1. H is positive definite if no spring or cell is compressed enough. One pass over them tells.
2. The load factor nu is the greatest number with H v = (1 - nu) H+ v. H+ is the projected Hessian,
   which has all of M and nothing negative, so no eigenvalue of M^(-1) H is below 1 - nu. A body
   buckles at nu = 1. The load factor grows as the load does (linear buckling analysis), so a load
   factor serves many steps.
3. The lowest eigenvalue of M^(-1) H is computed if nu is not small. A long search is made if the
   compression has grown or if a solve has met a negative curvature. At all other steps a few
   iterations follow the last mode, with multigrid only if its curvature has changed.

Tests 2 and 3 use locally optimal conjugate gradients on a block of directions, with the step's
preconditioner (Knyazev 2001, Toward the optimal preconditioned eigensolver, Algorithm 5.1).
A block is needed since a single direction may settle on a higher mode.
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

# Most iterations of a long search
MOST = 100
# A long search ends if the curvature is above this share of its value half as many
# iterations ago
SETTLED = 0.95
# A search ends if a negative curvature is above this multiple of its value two
# iterations ago
SHARPENED = 1.1
# Growth of the compression, or of the mode's curvature, beyond which another mode may
# be the lowest
MORE = 1.25
# Modes of at least this share of the lowest negative curvature count as equally steep
ALIKE = 0.9
TINY = np.finfo(float).tiny
# Relative eigenvalue of a Gram matrix below which directions are linearly dependent
DEPENDENT = 1e-10

# Directions (k, n), their products with H, and their products with M or the projected
# Hessian
Block = tuple[Rows, ...]
Act = Callable[[None, PETSc.Vec, PETSc.Vec], None]


class Alarm(IntEnum):
    """Place of a negative curvature that a solve has met, if any."""

    NOWHERE = 0
    ON_THE_WAY = 1
    HERE = 2


class SearchEffort(NamedTuple):
    """Effort of searches.

    block    : directions of a long search
    least    : fewest iterations of a long search
    followed : iterations of a short search, which has two directions
    """

    block: int
    least: int
    followed: int


EFFORT = SearchEffort(4, 12, 2)
# With multigrid smooth modes converge at once. After an alarm EFFORT is taken all the
# same: a folded body may hide its lowest mode.
UNIFORM_EFFORT = SearchEffort(2, 3, 1)
# Relative change of the mode's curvature below which the mode is taken as it is
UNCHANGED = 0.1
# Load factor up to which no mode need be known
LIGHT = 0.5
# Safety factor on a load factor of few iterations, which is a lower bound
UNSEEN = 1.2
# Growth of the compression up to which a body counts as loaded alike
GROWN = 4.0
# Share of the greatest compression below which a node does not tell how the load has
# grown
NEGLIGIBLE = 0.3


@dataclass(frozen=True)
class Compressed:
    """Greatest value and sum of t^2 concavity / m over the free nodes of all ranks."""

    greatest: float = 0.0
    total: float = 0.0


@dataclass(frozen=True)
class Compression(Compressed):
    """Compression of a body at given positions.

    inertia : whether M is part of H and outweighs negative parts of the elastic Hessian
    ratios  : t^2 concavity / m (m,) of this rank's free nodes
    """

    inertia: bool = True
    ratios: Floats = field(default_factory=lambda: np.empty(0))

    @property
    def least_curvature(self) -> float:
        """Lower bound of the eigenvalues of M^(-1) H.

        0 if M may not outweigh the negative parts.
        """
        return max(1 - self.greatest, 0.0) if self.inertia else 0.0


NONE = Compression()


class LowestCurvature:
    """Search for directions of negative curvature of a step's Hessian.

    All methods but properties are collective.

    preconditioner : of the step's linear solves; it switches to multigrid for a long search
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
        # Iterations, and products with H (multigrid's finest level included), of all
        # searches so far
        self.its = 0
        self.products = 0
        # Compression at which the last long search was made
        self.searched = Compressed()
        # Lowest known mode (n,), of unit length in the norm of M, and its curvature
        # when it was found
        self.mode: Floats | None = None
        self.value = 0.0
        # Whether the last checkpoint has the mode
        self.knows_mode = False
        # Last load factor, infinite if there is none, the compression (m,) there, and
        # its mode (n,)
        self.load = np.inf
        self.loads = np.zeros_like(functional.lattice.mass[self.unknowns.free])
        self.load_mode: Floats | None = None
        self.vectors = [self.unknowns.create_vector() for _ in range(2)]
        # Rigid motions (6, n) that a search leaves out
        self.rigid: Rows | None = None

    @property
    def effort(self) -> SearchEffort:
        """Effort of a search with the present preconditioner."""
        return UNIFORM_EFFORT if self.preconditioner.is_uniform else EFFORT

    def compression(self, q: Positions) -> Compression:
        """Return the compression at positions q (l, 3) [m] in the functional's problem."""
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
        """Return the lowest eigenvalue of M^(-1) H that a search finds, and its direction (n,).

        If the load factor is small, return a positive lower bound of the eigenvalue, and None.

        q    : positions (l, 3) [m] at which H was linearised last
        hint : a direction that may contain the mode
        """
        products = self.hessian.products + self.preconditioner.products
        is_known = not (alarm or self.unknowns.static)
        least = 1 - self._load(q, compression.ratios) if is_known else 0.0
        found = None if least >= 1 - LIGHT else self._lowest(q, compression, alarm, hint)
        self.products += self.hessian.products + self.preconditioner.products - products
        if found is None:
            # A body that is loaded more then has a long search
            self.searched = Compressed()
            return least, None
        values, modes = found
        # Springs of zero length have a cusp: g falls along any direction
        if not np.isfinite(values[0]):
            self.mode = None
            return -np.inf, self._random(1)[0]
        self.mode, self.value = modes[0].copy(), float(values[0])
        if values[0] < 0:
            # A body may buckle to several sides alike. The projection of noise on these
            # modes does not depend on their order, which is rounding's, so all ranks
            # take one side.
            down = modes[: int((values <= ALIKE * values[0]).sum())]
            parts = self.comm.allreduce(to_host((down * self.functional.mass) @ self._random(1)[0]))
            return values[0], like(down, parts / max(np.linalg.norm(parts), TINY)) @ down
        return values[0], self.mode

    def _lowest(
        self, q: Positions, compression: Compression, alarm: Alarm, hint: PETSc.Vec | None
    ) -> tuple[Floats, Rows]:
        """Return the lowest curvatures (k,) and their modes (k, n), by a short or a long search."""
        found, before = None, self.searched
        more = (
            compression.greatest > MORE * before.greatest or compression.total > MORE * before.total
        )
        # Another mode may be the lowest after an alarm or a greater compression
        if not (alarm or more):
            found = self._followed()
        if found is None:
            # After an alarm the next step makes a long search, too
            self.searched = (
                Compressed() if alarm else Compressed(compression.greatest, compression.total)
            )
            with self.preconditioner.searching(q, self.functional.contact_at(q)):
                found = self._search_at_length(
                    q, hint, EFFORT if alarm is Alarm.HERE else self.effort
                )
        return found

    def _load(self, q: Positions, ratios: Floats) -> float:
        """Return an upper bound of the load factor at positions q (l, 3) [m].

        While a body is loaded alike, its load factor grows as its compression (m,) does.
        """
        floor = NEGLIGIBLE * max(self.comm.allreduce(greatest(self.loads), MPI.MAX), DEPENDENT)
        growth = self.comm.allreduce(greatest(ratios / np.maximum(self.loads, floor)), MPI.MAX)
        load: float = UNSEEN * self.load * growth
        # So near the limit that the next growth would need another search
        is_heavy = MORE * UNSEEN * self.load > LIGHT
        if not np.isfinite(load) or (not is_heavy and (growth > GROWN or load > LIGHT)):
            with self.preconditioner.searching(q, self.functional.contact_at(q)):
                self.load = self._load_factor(q) if self.preconditioner.is_uniform else np.inf
            self.loads, load = ratios, UNSEEN * self.load
        return load

    def _load_factor(self, q: Positions) -> float:
        """Return the greatest nu with H v = (1 - nu) H+ v, H+ the projected Hessian."""
        functional, hessian = self.functional, self.hessian
        projected = TrueHessian(
            self.unknowns, functional.elasticity, functional.time_step, hessian.contact
        )
        projected.linearise(q, functional.contact_at(q), True)
        known = [] if self.load_mode is None else [self.load_mode[None]]
        start = np.concatenate([*known, self._random(2 - len(known))])
        values, modes = self._iterate(
            start, 2, MOST, UNIFORM_EFFORT.least - len(known), projected.mult
        )
        self.load_mode = modes[0].copy()
        hessian.products += projected.products
        return 1 - float(values[0])

    def _followed(self) -> tuple[Floats, Rows] | None:
        """Return the lowest curvatures and their modes near the last mode.

        Return None without a last mode, or if the mode has stiffened so much that another mode may
        be the lowest now.
        """
        if self.mode is None:
            return None
        its = self.effort.followed
        values, modes = self._iterate(self.mode[None], 1, 0, 0)
        if abs(values[0] - self.value) <= UNCHANGED * self.value:
            # The stored curvature stays, so that slow changes add up
            return np.array([self.value]), modes
        values, modes = self._iterate(
            np.concatenate([self.mode[None], self._random(1)]), 2, its, its
        )
        return None if values[0] > MORE * self.value else (values, modes)

    def _search_at_length(
        self, q: Positions, hint: PETSc.Vec | None, effort: SearchEffort
    ) -> tuple[Floats, Rows]:
        """Return the lowest curvatures and their modes by a long search from noise.

        Near a known mode a lower mode converges late, so the search begins with parts of all
        modes. Rigid motions have a curvature of about 1 and would hide a lower mode as long, so
        they are left out at first. A second search begins with the best of all directions.
        """
        is_uniform = effort is UNIFORM_EFFORT
        start = self._random(effort.block - (is_uniform and self.mode is not None))
        if hint is not None:
            start[0] += self._unit(self.memory.read(hint)[None])[0]
        known = [] if self.mode is None else [self.mode[None]]
        self.rigid = self._rigid_motions(q)
        # Nothing hides a mode, and all modes converge fast
        if self.rigid is None and is_uniform:
            return self._iterate(np.concatenate([start, *known]), effort.block, MOST, effort.least)
        _, modes = self._iterate(self._without_rigid(start), effort.block, MOST, effort.least)
        rigid, self.rigid = [] if self.rigid is None else [self.rigid], None
        return self._iterate(
            np.concatenate([modes, *known, *rigid]), effort.block, MOST, effort.least // 2
        )

    def _random(self, count: int) -> Rows:
        """Return preconditioned noise (count, n), which does not depend on the number of ranks."""
        return self._unit(self._of_each(self.preconditioner.apply, self.functional.noise(count)))

    def _iterate(
        self, start: Rows, block: int, most: int, least: int, weigh: Act | None = None
    ) -> tuple[Floats, Rows]:
        """Return the lowest eigenvalues (k,), k <= block, of W^(-1) H and their modes (k, n).

        start : directions (l, n)
        most  : most iterations
        least : fewest iterations
        weigh : applies W; M if None
        """
        size = min(block, len(start))
        values, (x, last) = self._ritz(self._block(start, weigh), size)
        # A small body has fewer modes than the block
        size, lowest = len(values), [values[0]]
        for its in range(1, most + 1):
            residuals = x[1] - like(start, values)[:, None] * x[2]
            sizes = np.array([greatest(np.abs(residual)) for residual in residuals])
            self.comm.Allreduce(MPI.IN_PLACE, sizes, MPI.MAX)
            # Multigrid works in single precision
            residuals /= like(residuals, np.maximum(sizes, TINY)[:, None])
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
        """Return the lowest Ritz values (size,) in the span of a block, ascending, and two blocks.

        The first block has the Ritz vectors, of unit length. The second block has the parts of
        the Ritz vectors outside the first ``size`` directions, the conjugate directions.
        """
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
        """Return translations and rotations (6, n) of a free body at positions q (l, 3) [m].

        They are orthonormal in M. Return None if nodes are fixed.
        """
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
        # Orthogonalised twice: the first pass leaves rounding
        for _ in range(2):
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
        """Return directions scaled to unit length in the norm of M; zero directions stay zero."""
        squares: Floats = self.comm.allreduce(to_host(directions**2 @ self.functional.mass))
        lengths: Rows = like(directions, np.maximum(np.sqrt(squares), TINY))[:, None]
        return directions / lengths

    def save(self, checkpoint: Checkpoint) -> None:
        """Store the mode and the searched compression, so that a restart needs no long search."""
        rows = np.zeros((self.functional.lattice.owned, 3), like=self.functional.lattice.nodes)
        self.knows_mode = self.mode is not None
        if self.mode is not None:
            rows[self.unknowns.free] = self.mode.reshape(3, -1).T
        loads = np.zeros_like(self.functional.lattice.mass)
        loads[self.unknowns.free] = self.loads
        checkpoint.keep({"lowest_mode": rows, "loads": loads})
        checkpoint.keep_counts(self)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Restore the mode and the searched compression."""
        checkpoint.restore_counts(self)
        if self.knows_mode:
            rows = like(self.functional.mass, checkpoint.row("lowest_mode"))
            self.mode = rows[self.unknowns.free].T.ravel()
        self.loads = like(self.functional.mass, checkpoint.row("loads"))[self.unknowns.free]

    def forget(self, modes: bool = True) -> None:
        """Forget all that a checkpoint does not hold; ``modes``: the mode and the load, too."""
        self.load_mode = None
        if modes:
            self.searched, self.mode, self.load = Compressed(), None, np.inf

    def destroy(self) -> None:
        for vector in self.vectors:
            vector.destroy()
