"""Which preconditioner a step's linear solves have: one of A, or multigrid of the Hessian on the lattice.

With Jacobi's, CG takes about sqrt(kappa) / 2 ln(2 / rtol) iterations, kappa = 2 (1 + t^2 k / m) where nothing is held,
k the springs at a node together; multigrid takes about four whatever that is, each as dear as several. So short steps
are Jacobi's, until they are seen to take longer than they should. A search for the lowest modes, which Jacobi's takes a
hundred iterations for, has multigrid of its own meanwhile.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from petsc4py import PETSc

from msmpetsc.comm import log
from msmpetsc.contact.obstacles.penalty import Contact
from msmpetsc.solve.linear.preconditioner import Preconditioner
from msmpetsc.solve.multigrid.preconditioner import LatticePreconditioner

MULTIGRID = PETSc.PC.Type.MG
LONG = 40  # iterations of Jacobi's that take longer than a few of multigrid's and its set-up
USUAL = 0.1  # ksp_rtol
LARGE = 3000  # free nodes: from there on a search with multigrid is the faster
MASSLESS = 1e9  # t^2 k / m: where nothing is held, the mass that alone says where a body goes is lost in rounding


def expected_iterations(ratio: float) -> float:
    """Iterations that Jacobi's takes where the greatest t^2 k / m of a node is ``ratio``."""
    return 0.5 * np.sqrt(2 * (1 + ratio)) * np.log(2 / USUAL)


class Preconditioned:
    """Context of the MATPYTHON (3m x 3m) that stands for what is preconditioned where PETSc wants a matrix of it."""

    def __init__(self, preconditioner: "StepPreconditioner"):
        self.preconditioner = preconditioner

    def view(self, _: PETSc.Mat, viewer: PETSc.Viewer) -> None:
        self.preconditioner.in_use.matrix.view(viewer)


class StepPreconditioner:
    """The one in use (a PCPYTHON context). All methods are collective.

    make_of_matrix, make_multigrid : make them where they are needed
    kind    : -pc_type; multigrid is taken where that is mg
    chooses : between the two, by ``ratio``, the greatest t^2 k / m of a node, and by the iterations seen
    nodes   : free ones, on all ranks
    """

    def __init__(
        self,
        make_of_matrix: Callable[[], Preconditioner],
        make_multigrid: Callable[[], LatticePreconditioner],
        kind: str,
        chooses: bool,
        ratio: float,
        nodes: int,
    ):
        self.make_multigrid, self.chooses = make_multigrid, chooses
        self.is_large, self.is_searching = nodes >= LARGE, False
        self.for_searches: LatticePreconditioner | None = None
        self.of_matrix: Preconditioner | None = None
        self.multigrid: LatticePreconditioner | None = None
        self.is_chosen = kind == MULTIGRID  # multigrid, for the steps
        expected = expected_iterations(ratio)
        if kind == MULTIGRID:
            self.multigrid = make_multigrid()
        elif chooses and expected > LONG:
            self._choose(f"t^2 k / m = {ratio:.3g}: Jacobi's would take some {expected:.0f} iterations")
        else:
            self.of_matrix = make_of_matrix()

    @property
    def in_use(self) -> Preconditioner | LatticePreconditioner:
        chosen = self.multigrid if self.is_chosen else self.of_matrix
        assert chosen is not None
        return chosen

    @property
    def is_uniform(self) -> bool:
        """Whether smooth errors fade as fast as rough ones."""
        return self.is_chosen or self.is_searching

    @property
    def products(self) -> int:
        """Products with the Hessian so far."""
        return sum(lattice.multigrid.fine.products for lattice in (self.multigrid, self.for_searches) if lattice)

    @contextmanager
    def searching(self, q: np.ndarray, contact: Contact | None) -> Iterator[None]:
        """Be multigrid, built at positions q (l, 3) [m], for a long search, where it may choose and the body is large:
        smooth modes, which come last with Jacobi's, then come at once. Steps have no part in it."""
        if self.is_chosen or not (self.chooses and self.is_large):
            yield
            return
        self.for_searches = self.for_searches or self.make_multigrid()
        self.for_searches.build_anew(q, contact)
        self.is_searching = True
        try:
            yield
        finally:
            self.is_searching = False

    def _choose(self, reason: str) -> None:
        self.is_chosen = True
        if self.multigrid is None:  # else it was chosen before, and forgotten
            log.info("preconditioner: multigrid on the lattice (%s a solve; -pc_type jacobi keeps to it)", reason)
            self.multigrid = self.make_multigrid()

    def prepare(self, q: np.ndarray, contact: Contact | None) -> bool:
        """Make ready to be applied about positions q (l, 3) [m]; whether that changed anything."""
        return self.in_use.prepare(q, contact)

    def balance(self, q: np.ndarray, contact: Contact | None, f: PETSc.Vec, x: PETSc.Vec) -> None:
        """Move bodies as wholes, from positions q (l, 3) [m] or unknowns x where F is f, to where their forces balance,
        where linear solves would not."""
        if self.multigrid and self.is_chosen:
            self.multigrid.balance(q, contact, f, x)

    @property
    def has_to_balance(self) -> bool:
        """Whether ``balance`` does anything."""
        return self.is_chosen and self.multigrid is not None and self.multigrid.translations is not None

    def learn(self, its: int, rtol: float) -> None:
        """A linear solve took so many iterations to a relative tolerance."""
        if self.multigrid and self.is_chosen:
            self.multigrid.learn(its, rtol)
        elif self.chooses and its * np.log(2 / USUAL) > LONG * np.log(2 / rtol):
            self._choose(f"Jacobi's took {its} iterations")

    def setFromOptions(self, pc: PETSc.PC) -> None:
        self.in_use.setFromOptions(pc)

    def setUp(self, pc: PETSc.PC) -> None:
        self.in_use.setUp(pc)

    def apply(self, pc: PETSc.PC | None, x: PETSc.Vec, y: PETSc.Vec) -> None:
        chosen = self.for_searches if self.is_searching and self.for_searches else self.in_use
        chosen.apply(pc, x, y)

    def view(self, pc: PETSc.PC, viewer: PETSc.Viewer) -> None:
        self.in_use.view(pc, viewer)

    def forget(self) -> None:
        """Know nothing of the steps before: what was chosen for its iterations is to be chosen anew."""
        self.is_chosen = self.of_matrix is None
        if self.multigrid:
            self.multigrid.forget()

    def destroy(self, _: PETSc.PC) -> None:
        for owned in (self.of_matrix, self.multigrid, self.for_searches):
            if owned:
                owned.destroy()
