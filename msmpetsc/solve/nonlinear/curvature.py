"""Lowest curvature of a step's true Hessian H = M + t^2 (Hessian of E).

F vanishes on a saddle of g, too, and a symmetric start never leaves the saddle. A pass over springs
or cells bounds the negative parts of H. If they are small enough, H is positive definite. Otherwise
the lowest eigenvalue of M^(-1) H is computed (nonlinear.lobpcg). A long search is made if the
compression has grown or if a solve has met a negative curvature. At all other steps an iteration
follows the last mode.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Floats, Positions, Rows, greatest, like, to_host
from msmpetsc.checkpoint import ANY, Checkpoint, Range
from msmpetsc.solve.linear.operators import TrueHessian
from msmpetsc.solve.nonlinear.functional import StepFunctional
from msmpetsc.solve.nonlinear.lobpcg import DEPENDENT, LONGEST_SEARCH, TINY, Lobpcg
from msmpetsc.solve.nonlinear.preconditioning import StepPreconditioner

# Modes of at least this share of the lowest negative curvature count as equally steep
ALIKE = 0.9
# Growth of the compression, or of the mode's curvature, beyond which another mode may
# be the lowest
MORE = 1.5
# Directions of a search of all modes
BLOCK = 3


@dataclass(frozen=True)
class Compression:
    """Compression of a body: t^2 concavity / m of the free nodes of all ranks.

    greatest : greatest value
    inertia  : whether M is part of H and outweighs negative parts of the elastic Hessian
    """

    greatest: float = 0.0
    inertia: bool = True

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

    preconditioner : of the step's linear solves
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
        # Greatest compression at which the last long search was made
        self.searched = 0.0
        # Lowest known mode (n,), of unit length in the norm of M, and its curvature
        # when it was found
        self.mode: Floats | None = None
        self.value = 0.0
        # Whether the last checkpoint has the mode
        self.knows_mode = False

    def compression(self, q: Positions) -> Compression:
        """Return the compression at positions q (l, 3) [m] in the functional's problem."""
        functional, free = self.functional, self.unknowns.free
        elasticity = functional.elasticity
        concavity = elasticity.concavity(q)[free]
        if functional.surface:
            concavity = concavity + functional.surface.concavity(q)[free]
        ratios = functional.t2 * concavity / functional.lattice.mass[free]
        most = self.comm.allreduce(greatest(ratios), MPI.MAX)
        return Compression(most, not self.unknowns.static)

    def lowest(
        self, q: Positions, compression: Compression, alarm: bool, hint: PETSc.Vec | None
    ) -> tuple[float, Floats | None]:
        """Return the lowest eigenvalue of M^(-1) H that a search finds, and its direction (n,).

        q     : positions (l, 3) [m] at which H was linearised last
        alarm : whether a solve has met a negative curvature
        hint  : a direction that may contain the mode
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
            # A body may buckle equally to several sides; rounding orders these modes.
            # The projection of noise on them does not depend on their order, so any
            # number of ranks takes the same side.
            down = modes[: int((values <= ALIKE * values[0]).sum())]
            noise = self.search.random(1)[0]
            parts = self.comm.allreduce(to_host((down * self.functional.mass) @ noise))
            return values[0], like(down, parts / max(np.linalg.norm(parts), TINY)) @ down
        return values[0], self.mode

    def _lowest(
        self, q: Positions, compression: Compression, alarm: bool, hint: PETSc.Vec | None
    ) -> tuple[Floats, Rows]:
        """Return the lowest curvatures (k,) and their modes (k, n), by a short or a long search."""
        # Another mode may be the lowest after an alarm or a greater compression
        is_same = not alarm and compression.greatest <= MORE * self.searched
        lowest = self._followed() if is_same else None
        if lowest is None:
            # After an alarm the next step makes a long search, too
            self.searched = 0.0 if alarm else compression.greatest
            lowest = self._long_search(q, hint)
        return lowest

    def _followed(self) -> tuple[Floats, Rows] | None:
        """Return the lowest curvatures and their modes near the last mode.

        Return None without a last mode, or if the mode has stiffened so much that another mode may
        be the lowest now.
        """
        if self.mode is None:
            return None
        values, modes = self.search.lowest([self.mode[None], self.search.random(1)], 2, 1)
        return None if values[0] > MORE * self.value else (values, modes)

    def _long_search(self, q: Positions, hint: PETSc.Vec | None) -> tuple[Floats, Rows]:
        """Return the lowest curvatures and their modes by a long search.

        A search from a known mode finds a lower mode late, so this search starts from random
        vectors, which have parts of all modes. Rigid motions have a curvature of about 1 and would
        delay a lower mode in the same way, so they are left out at first. A second search starts
        from these modes, the known mode and the rigid motions.
        """
        search, noise = self.search, self.search.random(BLOCK)
        if hint is not None:
            noise[0] += search.unit(self.functional.memory.read(hint)[None])[0]
        known = [] if self.mode is None else [self.mode[None]]
        rigid = self._rigid_motions(q)
        if rigid is None:
            return search.lowest([noise, *known], BLOCK, LONGEST_SEARCH)
        _, modes = search.lowest([search.without(rigid, noise)], BLOCK, LONGEST_SEARCH, rigid)
        return search.lowest([modes, *known, rigid], BLOCK, LONGEST_SEARCH)

    def _rigid_motions(self, q: Positions) -> Rows | None:
        """Return translations and rotations (6, n) of a free body at positions q (l, 3) [m].

        They are orthonormal in M. Return None if nodes or components are fixed.
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
        # Orthogonalised twice: the first pass leaves rounding
        for _ in range(2):
            sizes, parts = np.linalg.eigh(
                self.comm.allreduce(to_host((motions * self.functional.mass) @ motions.T))
            )
            kept = sizes > DEPENDENT * sizes[-1]
            motions = like(motions, (parts[:, kept] / np.sqrt(sizes[kept])).T) @ motions
        return motions

    def save(self, checkpoint: Checkpoint) -> None:
        """Store all that was found, so that a restart needs no long search."""
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
        self.searched, self.mode = 0.0, None
