"""Which preconditioner a step's linear solves have: one of A, or multigrid of the Hessian on the lattice.

With Jacobi's, CG takes about sqrt(kappa) / 2 ln(2 / rtol) iterations, kappa = 2 (1 + t^2 k / m) where nothing is held,
k the springs at a node together; multigrid takes about four whatever that is, each as dear as several. So short steps
are Jacobi's, until they are seen to take longer than they should.
"""

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.comm import log
from msmpetsc.model.checkpoint import Checkpoint
from msmpetsc.model.contact.penalty import Contact
from msmpetsc.solve.linear.preconditioner import Preconditioner
from msmpetsc.solve.multigrid.preconditioner import LatticePreconditioner

MULTIGRID = PETSc.PC.Type.MG
LONG = 40  # iterations of Jacobi's that take longer than a few of multigrid's and its set-up
USUAL = 0.1  # ksp_rtol


def expected_iterations(ratio: float) -> float:
    """Iterations that Jacobi's takes where the greatest t^2 k / m of a node is ``ratio``."""
    return 0.5 * np.sqrt(2 * (1 + ratio)) * np.log(2 / USUAL)


class StepPreconditioner:
    """The one in use (a PCPYTHON context). All methods are collective.

    of_matrix      : any PETSc preconditioner of A
    make_multigrid : makes the other one
    kind           : -pc_type; multigrid is taken where that is mg
    chooses        : between the two, by ``ratio``, the greatest t^2 k / m of a node, and by the iterations seen
    """

    def __init__(
        self,
        of_matrix: Preconditioner,
        make_multigrid: Callable[[], LatticePreconditioner],
        kind: str,
        chooses: bool,
        ratio: float,
    ):
        self.of_matrix, self.make_multigrid, self.chooses = of_matrix, make_multigrid, chooses
        self.multigrid: LatticePreconditioner | None = None
        if kind == MULTIGRID:
            self.multigrid = make_multigrid()
        elif chooses and expected_iterations(ratio) > LONG:
            self._choose(f"t^2 k / m = {ratio:.3g}: Jacobi's would take some {expected_iterations(ratio):.0f} iterations")

    @property
    def in_use(self) -> Preconditioner | LatticePreconditioner:
        return self.multigrid or self.of_matrix

    @property
    def is_uniform(self) -> bool:
        """Whether smooth errors fade as fast as rough ones."""
        return self.multigrid is not None

    def _choose(self, reason: str) -> None:
        log.info("preconditioner: multigrid on the lattice (%s a solve; -pc_type jacobi keeps to it)", reason)
        self.multigrid = self.make_multigrid()

    def prepare(self, q: np.ndarray, contact: Contact | None) -> None:
        """Make ready to be applied about positions q (l, 3) [m]."""
        if self.multigrid:
            self.multigrid.prepare(q, contact)

    def learn(self, its: int, rtol: float) -> None:
        """A linear solve took so many iterations to a relative tolerance."""
        if self.multigrid:
            self.multigrid.learn(its, rtol)
        elif self.chooses and its * np.log(2 / USUAL) > LONG * np.log(2 / rtol):
            self._choose(f"Jacobi's took {its} iterations")

    def setFromOptions(self, pc: PETSc.PC) -> None:
        self.in_use.setFromOptions(pc)

    def setUp(self, pc: PETSc.PC) -> None:
        self.in_use.setUp(pc)

    def apply(self, pc: PETSc.PC | None, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.in_use.apply(pc, x, y)

    def view(self, pc: PETSc.PC, viewer: PETSc.Viewer) -> None:
        self.in_use.view(pc, viewer)

    def save(self, checkpoint: Checkpoint) -> None:
        """Store what the next step depends on."""
        checkpoint.keep(numbers={"multigrid": self.multigrid is not None})
        if self.multigrid:
            self.multigrid.save(checkpoint)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint; from an empty one as if no step had been taken."""
        if checkpoint.count("multigrid", 1) and self.chooses and not self.multigrid:
            self.multigrid = self.make_multigrid()
        if self.multigrid:
            self.multigrid.restore(checkpoint)

    def destroy(self, _: PETSc.PC | None = None) -> None:
        for owned in (self.of_matrix, self.multigrid):
            if owned:
                owned.destroy(None)
