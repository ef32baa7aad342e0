"""Preconditioners of a step's linear solves: any PC of A, or multigrid of the Hessian.

With Jacobi's preconditioner CG takes about sqrt(kappa) / 2 ln(2 / rtol) iterations. In free space
kappa = 2 (1 + t^2 k / m), with k the stiffness of the springs at a node. Multigrid takes about four
iterations for any kappa, but each iteration costs several times as much. So short steps use
Jacobi's preconditioner, and longer steps use multigrid.
"""

import math
import sys

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Positions, Rows, like
from msmpetsc.comm import reduced
from msmpetsc.contact.step_contact import StepContactAt
from msmpetsc.contact.surface.surface_contact import SurfaceHessian
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.solve.linear.operators import Block
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.cycle import Multigrid
from msmpetsc.solve.multigrid.free_bodies import Translations
from msmpetsc.solve.petsc.device import HOST
from msmpetsc.solve.petsc.events import CYCLE, GRIDS, HIERARCHY

MULTIGRID = PETSc.PC.Type.MG
DIRECT = {PETSc.PC.Type.CHOLESKY, PETSc.PC.Type.LU}
# Greatest t^2 k / m of a node [-] above which multigrid is faster than Jacobi's
# preconditioner
STIFF = 15.0
# Greatest t^2 k / m of a node [-] from which rounding hides M in H; only M resists
# translations of a free body
MASSLESS = 1e9
# Number of iterations per digit with a hierarchy of the present positions
USUAL_RATE = 2.5
# Number of iterations that cost as much as a new hierarchy
WORTH = 10.0


class StepPreconditioner:
    """Preconditioner of a step's linear solves (a context of PCPYTHON).

    All methods are collective.

    is_uniform : whether smooth errors converge as fast as oscillating errors
    pc         : PETSc's preconditioner
    """

    is_uniform: bool
    unknowns: Unknowns
    pc: PETSc.PC

    @property
    def products(self) -> int:
        """Number of products with the Hessian so far."""
        return 0

    def prepare(self, q: Positions, contact: StepContactAt | None) -> bool:
        """Prepare for positions q (l, 3) [m]; return whether the preconditioner changed."""
        raise NotImplementedError

    def most_iterations(self, rtol: float) -> int | None:
        """Return the greatest number of iterations of a solve; None for PETSc's option.

        rtol : relative tolerance of the solve
        """
        return None

    def learn(self, its: int, reached: float) -> None:
        """Count the iterations of a linear solve that reduced its residual to ``reached`` [-]."""

    def renew(self) -> None:
        """Let the next ``prepare`` build a new preconditioner, unless this one is new."""

    def forget(self) -> None:
        """Forget data of earlier steps."""

    def setFromOptions(self, _: PETSc.PC) -> None:
        """Read the options -pc_... (PCSetFromOptions calls it)."""

    def setUp(self, _: PETSc.PC) -> None:
        """Set up the preconditioner (PCSetUp calls it)."""
        self.pc.setUp()

    def view(self, _: PETSc.PC, viewer: PETSc.Viewer) -> None:
        """Show the preconditioner (PCView calls it)."""
        self.pc.view(viewer)

    def apply(self, _: PETSc.PC | None, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Write P^-1 x to y (PCApply calls it)."""
        self._apply(x, y)
        self.unknowns.project(y)

    def _apply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Write P^-1 x to y, fixed components included."""
        raise NotImplementedError

    def destroy(self, pc: PETSc.PC | None = None) -> None:
        """Destroy all PETSc objects (PCDestroy calls it)."""
        raise NotImplementedError


class MatrixPreconditioner(StepPreconditioner):
    """Any PETSc preconditioner of A, applied to the three columns of coordinates.

    The options -pc_... choose the preconditioner for every preset, since A also preconditions the
    true Hessian. A bound on the blocks of contact is added to the diagonal of A. The sum is no less
    than A plus the blocks, so that a direct solve with the sum gives a descent direction, too.

    matrix  : A (m, m), a copy if there may be contact
    touches : whether there may be contact
    own     : (m,) this rank's diagonal of A [kg]
    added   : (m,) bound that is added to the diagonal, over t^2 [N/m]
    """

    is_uniform = False

    def __init__(
        self, matrix: PETSc.Mat, unknowns: Unknowns, prefix: str, time_step: float, touches: bool
    ):
        self.matrix, self.unknowns, self.t2, self.touches = matrix, unknowns, time_step**2, touches
        self.blocks: list[Block] = []
        self.pc = PETSc.PC().create(matrix.comm)
        self.pc.setOptionsPrefix(prefix)
        self.pc.setOperators(matrix)
        self.pc.setType(PETSc.PC.Type.JACOBI)
        self.vector = matrix.createVecLeft()
        matrix.getDiagonal(self.vector)
        self.own = unknowns.memory.read(self.vector).copy()
        self.added = np.zeros_like(self.own)

    def prepare(self, q: Positions, contact: StepContactAt | None) -> bool:
        """Add the bound of contact at positions q (l, 3) [m] (collective).

        Return whether the matrix changed.
        """
        if not self.touches:
            return False
        lattice = self.unknowns.lattice
        bound = (contact.bound() if contact else np.zeros(lattice.owned, like=q))[
            self.unknowns.free
        ]
        changed = bool(reduced(lattice.table.comm, not np.array_equal(bound, self.added), MPI.LOR))
        if changed:
            self.added = bound
            self.unknowns.memory.write(self.vector)[:] = self.own + self.t2 * bound
            self.matrix.setDiagonal(self.vector)
        return changed

    def setFromOptions(self, _: PETSc.PC) -> None:
        self.pc.setFromOptions()

    def _apply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Write P^-1 x to y, with all three columns in a single call, which MUMPS supports."""
        memory = self.unknowns.memory
        if not self.blocks:
            # A direct solver works on the CPU
            where = HOST if self.pc.getType() in DIRECT else memory
            self.blocks = [Block(self.matrix, where), Block(self.matrix, where)]
        right, solution = self.blocks
        values = right.values
        values[:] = like(values, memory.read(x))
        self.pc.matApply(right.mat, solution.mat)
        columns = memory.write(y)
        columns[:] = like(columns, solution.values)

    def destroy(self, _: PETSc.PC | None = None) -> None:
        for part in (*self.blocks, self.pc, self.vector):
            part.destroy()


class LatticePreconditioner(StepPreconditioner):
    """Multigrid of the Hessian, with a hierarchy that is kept while this saves time.

    matrix, pc   : projected Hessian, and PETSc's PCMG for it
    translations : exact translations of free bodies, used while ``is_free``; None if no body is
                   free
    is_first     : whether there is no hierarchy yet
    rate         : iterations per digit in the first solve with the hierarchy; None before it
    excess       : iterations above this rate since then
    is_stale     : whether a new hierarchy is due
    is_new       : whether the hierarchy was built at the positions of the next linear solve
    """

    is_uniform = True

    def __init__(self, unknowns: Unknowns, elasticity: Elasticity, time_step: float, prefix: str):
        self.unknowns = unknowns
        with GRIDS:
            self.multigrid = Multigrid(unknowns, elasticity, time_step, prefix)
        self.matrix, self.pc = self.multigrid.operator, self.multigrid.pc
        bodies = self.multigrid.bodies
        self.translations = Translations(unknowns, bodies) if bodies.free.any() else None
        self.is_first = True
        self.rate: float | None = None
        self.excess = 0.0
        self.is_stale, self.is_new, self.is_free = True, False, False

    @property
    def products(self) -> int:
        return self.multigrid.fine.products

    def prepare(self, q: Positions, contact: StepContactAt | None) -> bool:
        """Build a hierarchy at positions q (l, 3) [m] if due. Return whether the hierarchy changed.

        A kept hierarchy follows the contact of single nodes, since each node that has come into
        contact would cost several iterations.
        """
        self.is_free, self.is_new = self._is_free(contact), self.is_stale
        if self.is_new:
            surface = contact.surface.hessian(True) if contact and contact.surface else None
            self._build(q.copy(), self._blocks(contact), surface)
        elif contact and not contact.surface:
            return self._follow(self._blocks(contact))
        return self.is_new

    def _follow(self, contact: Rows) -> bool:
        """Give the hierarchy the present contact (owned, 9) [N/m]. Return whether that changed."""
        changed = not np.array_equal(contact, self.multigrid.fine.contact)
        changed = bool(reduced(self.unknowns.comm, changed, MPI.LOR))
        if changed:
            with HIERARCHY:
                self.multigrid.follow(contact)
        return changed

    def most_iterations(self, rtol: float) -> int | None:
        # a hierarchy of the present positions, or before its first solve, has no limit
        if self.is_new or self.rate is None:
            return None
        return int(self.rate * _digits(rtol) + WORTH)

    def learn(self, its: int, reached: float) -> None:
        """Count the iterations of a linear solve that reduced its residual to ``reached`` [-].

        A hierarchy is kept until its excess iterations have cost as much as a new hierarchy. So the
        total cost is at most twice the least possible cost.
        """
        if its == 0:
            return
        digits = _digits(reached)
        if self.rate is None:
            self.rate = its / digits
        self.excess += max(its - self.rate * digits, 0.0)
        self.is_stale |= self.excess > WORTH

    def renew(self) -> None:
        self.is_stale |= not self.is_new

    def _build(self, q: Positions, contact: Rows, surface: SurfaceHessian | None) -> None:
        with HIERARCHY:
            self.multigrid.update(q, contact, surface)
        self.rate = USUAL_RATE if self.is_first else None
        self.excess = 0.0
        self.is_first = self.is_stale = False

    def _is_free(self, contact: StepContactAt | None) -> bool:
        """Return whether mass alone resists translations of free bodies.

        This holds if there are free bodies, and no contact presses on them.
        """
        if self.translations is None or contact is None:
            return self.translations is not None
        surface = contact.surface
        alone = len(self.multigrid.bodies.free) == 1 and not (
            surface and surface.contacts.obstacles.total
        )
        # Self-contact of a single body does not move its centre, like springs
        if surface and not alone and surface.presses:
            return False
        return not reduced(self.unknowns.comm, contact.presses_nodes, MPI.LOR)

    def _blocks(self, contact: StepContactAt | None) -> Rows:
        """Return the Hessian (owned, 9) [N/m] of obstacles on nodes, with the secant of friction.

        Return (0, 9) without contact.
        """
        lattice = self.unknowns.lattice
        blocks = np.zeros((lattice.owned if contact else 0, 9), like=lattice.nodes)
        for nodes, added in contact.hessian(contact.step.no_duals()) if contact else ():
            blocks[nodes] += added.reshape(-1, 9)
        return blocks

    def view(self, _: PETSc.PC, viewer: PETSc.Viewer) -> None:
        for line in repr(self.multigrid).splitlines():
            viewer.printfASCII(f"    {line}\n")
        self.pc.view(viewer)

    def _apply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Write P^-1 x to y by a cycle."""
        with CYCLE:
            if self.translations and self.is_free:
                self.translations.around(self.pc, x, y)
            else:
                self.pc.apply(x, y)

    def forget(self) -> None:
        """Forget the hierarchy, so that the next step builds a new hierarchy."""
        self.is_stale = self.is_first = True

    def destroy(self, _: PETSc.PC | None = None) -> None:
        self.multigrid.destroy()


def _digits(reached: float) -> float:
    """Return the number of digits in a reduction of the residual to ``reached``, at least 0.1."""
    return max(-math.log10(max(reached, sys.float_info.epsilon)), 0.1)
