"""Multigrid as a step's preconditioner: built where it is first needed, kept from step to step while it serves."""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.contact.obstacles.penalty import Contact
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.bodies import Translations
from msmpetsc.solve.multigrid.cycle import Multigrid
from msmpetsc.solve.petsc.events import CYCLE, GRIDS, HIERARCHY

USUAL_PACE = 2.5  # iterations a digit with a hierarchy of the present: what the one at rest is held against
WORTH = 10.0  # iterations that a new hierarchy takes the time of


class LatticePreconditioner:
    """The cycle (a PCPYTHON context), and where its hierarchy was built. All methods are collective.

    touches  : steps may have a ``contact``
    translations : of bodies that nothing holds, kept exactly while ``is_free``; None where all are held
    is_first : there is none yet
    pace     : iterations a digit of the first solve with it; None before that
    wasted   : iterations since then that were more than that
    is_stale : a new one is due
    """

    def __init__(
        self,
        comm: MPI.Comm,
        unknowns: Unknowns,
        elasticity: Elasticity,
        time_step: float,
        prefix: str,
        touches: bool,
    ):
        self.comm, self.unknowns, self.touches = comm, unknowns, touches
        with GRIDS:
            self.multigrid = Multigrid(comm, unknowns, elasticity, time_step, prefix)
        bodies = self.multigrid.bodies
        self.translations = Translations(comm, unknowns, bodies) if bodies.free.any() else None
        self.is_first = True
        self.pace: float | None = None
        self.wasted = 0.0
        self.is_stale, self.is_free = True, False

    @property
    def matrix(self) -> PETSc.Mat:
        """The projected Hessian."""
        return self.multigrid.operator

    def prepare(self, q: np.ndarray, contact: Contact | None) -> bool:
        """See to it that there is a hierarchy that serves; whether it is a new one, at positions q (l, 3) [m]."""
        due = self.is_stale
        self.is_free = self._is_free(q, contact)
        if due:
            self._build(q.copy(), self._blocks(q, contact))
        return due

    def build_anew(self, q: np.ndarray, contact: Contact | None) -> None:
        """Build the hierarchy at positions q (l, 3) [m], whatever there was."""
        self.is_stale = True
        self.prepare(q, contact)

    def balance(self, q: np.ndarray, contact: Contact | None, f: PETSc.Vec, x: PETSc.Vec) -> None:
        """Move bodies that nothing holds as wholes, from positions q (l, 3) [m] or unknowns x where F is f, to where
        their forces balance: linear solves leave them there."""
        if self.translations and self._is_free(q, contact):
            columns = self.unknowns.columns_to_write(x)
            columns -= self.translations.of(self.unknowns.columns(f))

    def learn(self, its: int, rtol: float) -> None:
        """A linear solve took so many iterations to a relative tolerance; none say nothing.

        A hierarchy is kept until what it has cost would have paid for a new one: at worst that is twice the least.
        """
        if its == 0:
            return
        digits = max(-np.log10(rtol), 0.1)
        if self.pace is None:
            self.pace = its / digits
        self.wasted += max(its - self.pace * digits, 0.0)
        self.is_stale |= self.wasted > WORTH

    def _build(self, q: np.ndarray, contact: np.ndarray) -> None:
        with HIERARCHY:
            self.multigrid.update(q, contact)
        self.pace, self.wasted = USUAL_PACE if self.is_first else None, 0.0
        self.is_first = self.is_stale = False

    def _is_free(self, q: np.ndarray, contact: Contact | None) -> bool:
        """Whether no obstacle presses on a node at positions q (l, 3) [m]: translations then meet nothing but mass."""
        if self.translations is None or contact is None:
            return self.translations is not None
        if contact.surface and len(self.multigrid.bodies.free) > 1 and contact.surface.presses(q):
            return False  # of one body alone it moves the middle no more than springs do
        pressed = any(len(nodes) for nodes, _ in contact.hessian(q, True))
        return not self.comm.allreduce(pressed, MPI.LOR)

    def _blocks(self, q: np.ndarray, contact: Contact | None) -> np.ndarray:
        """The Hessian of contact (owned, 9) at q, friction's by its secant; (0, 9) where there is none."""
        lattice = self.unknowns.lattice
        blocks = np.zeros((lattice.owned if contact else 0, 9), like=lattice.nodes)
        for nodes, added in contact.hessian(q, False) if contact else ():
            blocks[nodes] += added.reshape(-1, 9)
        surface = contact.surface.hessian(q, True) if contact and contact.surface else None
        return blocks + surface.blocks if surface else blocks

    def setFromOptions(self, _: PETSc.PC) -> None:
        """The options are read when the levels are there."""

    def setUp(self, _: PETSc.PC) -> None:
        self.multigrid.pc.setUp()

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        with CYCLE:
            if self.translations and self.is_free:
                self.translations.around(self.multigrid.pc, x, y)
            else:
                self.multigrid.pc.apply(x, y)

    def view(self, _: PETSc.PC, viewer: PETSc.Viewer) -> None:
        self.multigrid.pc.view(viewer)

    def forget(self) -> None:
        """Know nothing of the steps before: a new hierarchy is due."""
        self.is_stale = self.is_first = True

    def destroy(self) -> None:
        self.multigrid.destroy()
