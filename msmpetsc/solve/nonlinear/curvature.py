"""Lowest curvature of a step's true Hessian H = M + t^2 (Hessian of E).

F vanishes on a saddle of g, too, and a symmetric start never leaves the saddle. A pass over springs
or cells bounds the negative parts of H. If they are small enough, H is positive definite. Otherwise
the lowest eigenvalue of M^(-1) H is computed (nonlinear.lobpcg). If the compression has grown, or
if a solve has met a negative curvature, the search is long. Otherwise a few iterations follow the
last mode if its curvature has changed.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar

import numpy as np
from petsc4py import PETSc

from msmpetsc.backend.arrays import Floats, Positions, Rows, greatest, like, to_host
from msmpetsc.checkpoint import ANY, Checkpoint, Range
from msmpetsc.comm import reduced
from msmpetsc.solve.linear.operators import TrueHessian
from msmpetsc.solve.nonlinear.functional import Configuration, StepFunctional
from msmpetsc.solve.nonlinear.lobpcg import (
    DEPENDENT,
    EFFORT,
    LONGEST_SEARCH,
    TINY,
    UNCHANGED,
    UNIFORM_EFFORT,
    Lobpcg,
    SearchEffort,
)
from msmpetsc.solve.nonlinear.preconditioning import StepPreconditioner

# Growth of the compression, or of the mode's curvature, beyond which another mode may
# be the lowest [-]
MORE = 2.0


class Alarm(IntEnum):
    """Place of a negative curvature that a solve has met: at this iterate or an earlier iterate."""

    NOWHERE = 0
    ON_THE_WAY = 1
    HERE = 2


@dataclass(frozen=True)
class Compression:
    """Compression of a body: t^2 concavity / m [-] over the free nodes of all ranks.

    greatest : greatest value
    total    : sum of all values
    inertia  : whether M is part of H, so that it may outweigh negative parts; False in statics
    """

    greatest: float = 0.0
    total: float = 0.0
    inertia: bool = True

    @property
    def least_curvature(self) -> float:
        """Lower bound of the eigenvalues of M^(-1) H; 0 if M may not outweigh negative parts."""
        return max(1 - self.greatest, 0.0) if self.inertia else 0.0


NONE = Compression()


class LowestCurvature:
    """Search for directions of negative curvature of a step's Hessian.

    All methods but properties are collective.

    preconditioner : preconditioner of the step's linear solves
    """

    state: ClassVar[dict[str, Range]] = {
        "searched": ANY,
        "value": ANY,
        "knows_mode": (0, 1),
    }

    def __init__(
        self, functional: StepFunctional, hessian: TrueHessian, preconditioner: StepPreconditioner
    ):
        self.functional, self.hessian, self.preconditioner = functional, hessian, preconditioner
        self.comm, self.unknowns = functional.comm, functional.unknowns
        self.search = Lobpcg(functional, hessian, preconditioner)
        # Products with H (multigrid's finest level included) of all searches so far
        self.products = 0
        # Compression at which the last long search was made
        self.searched = NONE
        # Lowest known mode (n,), of unit length in the norm of M, and the curvature
        # with which it was found
        self.mode: Floats | None = None
        self.value = 0.0
        # Whether the last checkpoint has the mode
        self.knows_mode = False

    @property
    def effort(self) -> SearchEffort:
        """Effort of searches with the present preconditioner."""
        return UNIFORM_EFFORT if self.preconditioner.is_uniform else EFFORT

    def compression(self, configuration: Configuration) -> Compression:
        """Return the compression of a configuration."""
        functional, free = self.functional, self.unknowns.free
        elasticity = functional.elasticity
        concavity = elasticity.concavity(configuration.q)[free]
        if configuration.contact and configuration.contact.surface:
            concavity = concavity + configuration.contact.surface.concavity()[free]
        ratios = functional.t2 * concavity / functional.lattice.mass[free]
        most, sums = zip(*self.comm.allgather((greatest(ratios), float(ratios.sum()))), strict=True)
        return Compression(max(most), sum(sums), not self.unknowns.static)

    def lowest(
        self, q: Positions, compression: Compression, alarm: Alarm, hint: PETSc.Vec | None
    ) -> tuple[float, Floats | None]:
        """Return the lowest eigenvalue of M^(-1) H that a search finds, and its direction (n,).

        The eigenvalue is -inf at springs of zero length.

        q    : positions (l, 3) [m] at which H was linearised last
        hint : a direction that may contain the mode
        """
        products = self.hessian.products + self.preconditioner.products
        values, modes = self._lowest(q, compression, alarm, hint)
        self.products += self.hessian.products + self.preconditioner.products - products
        # Springs of zero length have a cusp: g falls along any direction
        if not np.isfinite(values[0]):
            self.mode = None
            return -np.inf, self.search.random(1)[0]
        self.mode, self.value = modes[0].copy(), float(values[0])
        if values[0] < 0:
            # A body may buckle equally to several sides, and rounding orders these
            # modes. The projection of noise onto the modes does not depend on their
            # order, so any number of ranks takes the same side.
            down = modes[: int((values < 0).sum())]
            noise = self.search.random(1)[0]
            parts = reduced(self.comm, to_host((down * self.functional.mass) @ noise))
            return values[0], like(down, parts / max(np.linalg.norm(parts), TINY)) @ down
        return values[0], self.mode

    def _lowest(
        self, q: Positions, compression: Compression, alarm: Alarm, hint: PETSc.Vec | None
    ) -> tuple[Floats, Rows]:
        """Return the lowest curvatures (k,) and their modes (k, n), by a short or a long search."""
        lowest, before = None, self.searched
        more = (
            compression.greatest > MORE * before.greatest or compression.total > MORE * before.total
        )
        # Another mode may be the lowest after an alarm or a greater compression
        if not (alarm or more):
            lowest = self._followed()
        if lowest is None:
            # After an alarm the next step makes a long search, too
            self.searched = NONE if alarm else compression
            lowest = self._long_search(q, hint, EFFORT if alarm is Alarm.HERE else self.effort)
        return lowest

    def _followed(self) -> tuple[Floats, Rows] | None:
        """Return the lowest curvatures and their modes near the last mode.

        Return None without a last mode. Return None, too, if the mode has stiffened so much that
        another mode may be the lowest now.
        """
        if self.mode is None:
            return None
        its = self.effort.followed
        if abs(self.search.curvature(self.mode) - self.value) <= UNCHANGED * self.value:
            # The stored curvature stays, so that slow changes add up
            return np.array([self.value]), self.mode[None]
        start = [self.mode[None], self.search.random(1)]
        values, modes = self.search.lowest(start, 2, its, its)
        return None if values[0] > MORE * self.value else (values, modes)

    def _long_search(
        self, q: Positions, hint: PETSc.Vec | None, effort: SearchEffort
    ) -> tuple[Floats, Rows]:
        """Return the lowest curvatures and their modes by a long search.

        A search from a known mode finds a lower mode late, so this search starts from random
        vectors, which have parts of all modes. Rigid motions have a curvature of about 1 and would
        delay a lower mode in the same way, so the first search leaves them out. A second search
        starts from the modes found, the known mode and the rigid motions.
        """
        is_uniform = effort is UNIFORM_EFFORT
        search, block, least = self.search, effort.block, effort.least
        known = [] if self.mode is None else [self.mode[None]]
        rigid = self._rigid_motions(q)

        def noise(count: int) -> Rows:
            start = search.random(count)
            if hint is not None:
                start[0] += search.unit(self.functional.memory.read(hint)[None])[0]
            return start

        # No rigid motion delays a mode, and all modes converge fast
        if rigid is None and is_uniform:
            start = [noise(block - len(known)), *known]
            return search.lowest(start, block, LONGEST_SEARCH, least)
        start = [search.without(rigid, noise(block - is_uniform * len(known)))]
        _, modes = search.lowest(start, block, LONGEST_SEARCH, least, left_out=rigid)
        start = [modes, *known, *([] if rigid is None else [rigid])]
        return search.lowest(start, block, LONGEST_SEARCH, least // 2)

    def _rigid_motions(self, q: Positions) -> Rows | None:
        """Return translations and rotations (k, n), k <= 6, of a free body at positions q (l, 3).

        The motions are orthonormal in M; degenerate bodies have fewer than 6. Return None if nodes
        or components are fixed.
        """
        if self.unknowns.has_fixed:
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
        # Orthogonalise twice, because the first pass leaves rounding
        for _ in range(2):
            sizes, parts = np.linalg.eigh(
                reduced(self.comm, to_host((motions * self.functional.mass) @ motions.T))
            )
            kept = sizes > DEPENDENT * sizes[-1]
            motions = like(motions, (parts[:, kept] / np.sqrt(sizes[kept])).T) @ motions
        return motions

    def save(self, checkpoint: Checkpoint) -> None:
        """Store the mode and the searched compression, so that a restart needs no long search."""
        shape = self.functional.lattice.owned, 3
        self.knows_mode = self.mode is not None
        rows: Rows = np.broadcast_to(0.0, shape)
        if self.mode is not None:
            rows = np.zeros(shape, like=self.mode)
            rows[self.unknowns.free] = self.mode.reshape(3, -1).T
        checkpoint.keep({"lowest_mode": rows})
        checkpoint.keep_counts(self)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Restore the mode and the searched compression."""
        checkpoint.restore_counts(self)
        if self.knows_mode:
            rows = like(self.functional.mass, checkpoint.row("lowest_mode"))
            self.mode = rows[self.unknowns.free].T.ravel()

    def forget(self) -> None:
        """Forget the mode and its search."""
        self.searched, self.mode = NONE, None
