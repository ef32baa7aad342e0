"""Preconditioners of a step's linear solves: of A, or multigrid of the Hessian on the lattice.

With Jacobi's, CG takes about sqrt(kappa) / 2 ln(2 / rtol) iterations, kappa = 2 (1 + t^2 k / m) where nothing is held,
k the springs at a node together; multigrid takes about four whatever that is, each as dear as several. So short steps
are Jacobi's, until they are seen to take longer than they should. A search for the lowest modes, which Jacobi's takes a
hundred iterations for, has multigrid of its own meanwhile.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Positions, Rows, like
from msmpetsc.comm import log
from msmpetsc.contact.obstacles.penalty import Contact
from msmpetsc.contact.surface.term import SurfaceHessian
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.solve.linear.operators import Block
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.cycle import Multigrid
from msmpetsc.solve.multigrid.free_bodies import Translations
from msmpetsc.solve.petsc.device import HOST
from msmpetsc.solve.petsc.events import CYCLE, GRIDS, HIERARCHY

MULTIGRID = PETSc.PC.Type.MG
DIRECT = {PETSc.PC.Type.CHOLESKY, PETSc.PC.Type.LU}
LONG = 40  # iterations of Jacobi's that take longer than a few of multigrid's and its set-up
USUAL = 0.1  # ksp_rtol
LARGE = 1000  # free nodes: from there on a search with multigrid is the faster
USUAL_PACE = (
    2.5  # iterations a digit with a hierarchy of the present: what the one at rest is held against
)
WORTH = 10.0  # iterations that a new hierarchy takes the time of
PATIENCE = (
    15.0  # iterations beyond its pace that a solve with an old one is given: one took 2,300 else
)
MASSLESS = 1e9  # t^2 k / m: where nothing is held, the mass that alone says where a body goes is lost in rounding


class Preconditioner:
    """Any PETSc preconditioner of A, applied to the three columns, with a bound on contact's blocks on A's diagonal.

    It is this inner one that the options -pc_... set, for every preset: A is also what the true
    Hessian is preconditioned with. A + t^2 bound is no less than A plus the blocks, so that a direct solve with it is a
    step downhill too.

    matrix  : A, m x m, of its own where there may be contact: all three columns go in one call, as MUMPS can
    touches : whether there may be
    own     : (m,) diagonal of A, of this rank [kg]
    added   : (m,) what is added to it, over t^2 [N/m]
    """

    def __init__(
        self, matrix: PETSc.Mat, unknowns: Unknowns, prefix: str, time_step: float, touches: bool
    ):
        self.matrix, self.unknowns, self.t2, self.touches = matrix, unknowns, time_step**2, touches
        self.blocks: list[Block] = []
        self.pc = PETSc.PC().create(matrix.comm)
        self.pc.setOptionsPrefix(prefix)
        self.pc.setOperators(matrix)
        self.vector = matrix.createVecLeft()
        matrix.getDiagonal(self.vector)
        self.own = unknowns.memory.read(self.vector).copy()
        self.added = np.zeros_like(self.own)

    def prepare(self, q: Positions, contact: Contact | None) -> bool:
        """Add the bound of contact at positions q (l, 3) [m]; whether that changed the matrix (collective)."""
        if not self.touches:
            return False
        lattice = self.unknowns.lattice
        bound = (contact.bound(q) if contact else np.zeros(lattice.owned, like=q))[
            self.unknowns.free
        ]
        changed = bool(lattice.table.comm.allreduce(not np.array_equal(bound, self.added), MPI.LOR))
        if changed:
            self.added = bound
            self.unknowns.memory.write(self.vector)[:] = self.own + self.t2 * bound
            self.matrix.setDiagonal(self.vector)
        return changed

    def apply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        memory = self.unknowns.memory
        if not self.blocks:  # where the inner preconditioner works: a direct solver does on the CPU
            where = HOST if self.pc.getType() in DIRECT else memory
            self.blocks = [Block(self.matrix, where), Block(self.matrix, where)]
        right, solution = self.blocks
        values = right.values
        values[:] = like(values, memory.read(x))
        self.pc.matApply(right.mat, solution.mat)
        columns = memory.write(y)
        columns[:] = like(columns, solution.values)

    def by_diagonal(self, r: Rows) -> Rows:
        """Return D^-1 r (3, m), D the diagonal of A."""
        return r / (self.own + self.t2 * self.added)

    def destroy(self) -> None:
        for part in (*self.blocks, self.pc, self.vector):
            part.destroy()


class LatticePreconditioner:
    """Multigrid of the Hessian, with a hierarchy that is kept while it pays. Collective.

    matrix, pc   : the projected Hessian, and PETSc's PCMG of it
    translations : of bodies that nothing holds, kept exactly while ``is_free``; None where all are held
    is_first : there is none yet
    pace     : iterations a digit of the first solve with it; None before that
    wasted   : iterations since then that were more than that
    is_stale : a new one is due; ``is_new``: the present one was built where the linear solve to come was linearised
    """

    def __init__(self, unknowns: Unknowns, elasticity: Elasticity, time_step: float, prefix: str):
        self.unknowns = unknowns
        with GRIDS:
            self.multigrid = Multigrid(unknowns, elasticity, time_step, prefix)
        self.matrix, self.pc = self.multigrid.operator, self.multigrid.pc
        bodies = self.multigrid.bodies
        self.translations = Translations(unknowns, bodies) if bodies.free.any() else None
        self.is_first = True
        self.pace: float | None = None
        self.wasted = 0.0
        self.is_stale, self.is_new, self.is_free = True, False, False

    def prepare(self, q: Positions, contact: Contact | None) -> bool:
        """Build a hierarchy at positions q (l, 3) [m] if a new one is due; whether it was."""
        self.is_free, is_due = self._is_free(q, contact), self.is_stale
        self.is_new = is_due
        if is_due:
            surface = contact.surface.hessian(q, True) if contact and contact.surface else None
            self._build(q.copy(), self._blocks(q, contact), surface)
        return is_due

    def balance(self, q: Positions, contact: Contact | None, f: PETSc.Vec, x: PETSc.Vec) -> None:
        """Move bodies that nothing holds as wholes to where forces balance, from q, or unknowns x, where F is f."""
        if self.translations and self._is_free(q, contact):
            columns = self.unknowns.columns_to_write(x)
            columns -= self.translations.of(self.unknowns.columns(f))

    def most_iterations(self, rtol: float) -> int | None:
        """Iterations of a solve to a relative tolerance that this hierarchy is given; None where it is of this x."""
        return (
            None
            if self.is_new or self.pace is None
            else int(self.pace * _digits(rtol) + PATIENCE - self.wasted)
        )

    def learn(self, its: int, rtol: float) -> None:
        """Take note of the iterations that a linear solve took to a relative tolerance.

        A hierarchy is kept until what it has cost would have paid for a new one: at worst that is twice the least.
        """
        if its == 0:
            return
        digits = _digits(rtol)
        if self.pace is None:
            self.pace = its / digits
        self.wasted += max(its - self.pace * digits, 0.0)
        self.is_stale |= self.wasted > WORTH

    def _build(self, q: Positions, contact: Rows, surface: SurfaceHessian | None) -> None:
        with HIERARCHY:
            self.multigrid.update(q, contact, surface)
        self.pace = None
        if self.is_first:
            self.pace = USUAL_PACE
        self.wasted = 0.0
        self.is_first = self.is_stale = False

    def _is_free(self, q: Positions, contact: Contact | None) -> bool:
        """Whether no obstacle presses on a node at positions q (l, 3) [m]: translations then meet nothing but mass."""
        if self.translations is None or contact is None:
            return self.translations is not None
        surface = contact.surface
        alone = len(self.multigrid.bodies.free) == 1 and not (
            surface and surface.contacts.obstacles.total
        )
        if surface and not alone and surface.presses(q):
            return False  # of one body alone it moves the middle no more than springs do
        pressed = any(len(nodes) for nodes, _ in contact.hessian(q))
        return not self.unknowns.comm.allreduce(pressed, MPI.LOR)

    def _blocks(self, q: Positions, contact: Contact | None) -> Rows:
        """Hessian of obstacles (owned, 9) at q, friction's by its secant; (0, 9) if there are none."""
        lattice = self.unknowns.lattice
        blocks = np.zeros((lattice.owned if contact else 0, 9), like=lattice.nodes)
        for nodes, added in contact.hessian(q, contact.no_duals()) if contact else ():
            blocks[nodes] += added.reshape(-1, 9)
        return blocks

    def apply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        with CYCLE:
            if self.translations and self.is_free:
                self.translations.around(self.pc, x, y)
            else:
                self.pc.apply(x, y)

    def by_diagonal(self, r: Rows) -> Rows:
        """Return D^-1 r (3, m), D the 3 x 3 blocks of each node."""
        return self.multigrid.fine.by_blocks(r, np.empty_like(r))

    def forget(self) -> None:
        """Forget the hierarchy: the next step builds a new one."""
        self.is_stale = self.is_first = True
        self.multigrid.contact.destroy()

    def destroy(self) -> None:
        self.multigrid.destroy()


def _digits(rtol: float) -> float:
    return max(-float(np.log10(rtol)), 0.1)


def expected_iterations(ratio: float) -> float:
    """Iterations that Jacobi's takes where the greatest t^2 k / m of a node is ``ratio``."""
    return float(0.5 * np.sqrt(2 * (1 + ratio)) * np.log(2 / USUAL))


@dataclass(eq=False)
class StepPreconditioner:
    """Preconditioner of a step's solves, of A or of the Hessian (a PCPYTHON context). Collective.

    make_of_matrix, make_multigrid : make them where they are needed
    chooses : between the two, by ``ratio``, the greatest t^2 k / m of a node, and by the iterations seen
    """

    make_of_matrix: Callable[[], Preconditioner]
    make_multigrid: Callable[[], LatticePreconditioner]
    kind: str  # -pc_type; multigrid is taken where that is mg
    chooses: bool
    ratio: float
    nodes: int  # free ones, on all ranks

    def __post_init__(self) -> None:
        self.is_searching = False
        self.for_searches: LatticePreconditioner | None = None
        self.of_matrix: Preconditioner | None = None
        self.multigrid: LatticePreconditioner | None = None
        self.is_chosen = self.kind == MULTIGRID  # multigrid, for the steps
        expected = expected_iterations(self.ratio)
        if self.is_chosen:
            self.multigrid = self.make_multigrid()
        elif self.chooses and expected > LONG:
            self._choose(
                f"t^2 k / m = {self.ratio:.3g}: Jacobi's would take some {expected:.0f} iterations a solve"
            )
        else:
            self.of_matrix = self.make_of_matrix()

    @property
    def in_use(self) -> Preconditioner | LatticePreconditioner:
        chosen = self.multigrid if self.is_chosen else self.of_matrix
        assert chosen is not None
        return chosen

    def prepare(self, q: Positions, contact: Contact | None) -> bool:
        """Take positions q (l, 3) [m]; whether that changed what is preconditioned with."""
        if (
            self.chooses
            and not self.is_chosen
            and contact
            and contact.surface
            and contact.surface.presses(q)
        ):
            self._choose("the surface presses on itself")
        return self.in_use.prepare(q, contact)

    @property
    def is_uniform(self) -> bool:
        """Whether smooth errors fade as fast as rough ones."""
        return self.is_chosen or self.is_searching

    @property
    def products(self) -> int:
        """Products with the Hessian so far."""
        return sum(
            lattice.multigrid.fine.products
            for lattice in (self.multigrid, self.for_searches)
            if lattice
        )

    @contextmanager
    def searching(self, q: Positions, contact: Contact | None) -> Iterator[None]:
        """Switch to multigrid, built at positions q (l, 3) [m], for a long search in a large body.

        Smooth modes, which come last with Jacobi's, then come at once. Steps have no part in it.
        """
        if self.is_chosen or not self.chooses or self.nodes < LARGE:
            yield
            return
        self.for_searches = self.for_searches or self.make_multigrid()
        self.for_searches.is_stale = True
        self.for_searches.prepare(q, contact)
        self.is_searching = True
        try:
            yield
        finally:
            self.is_searching = False

    def _choose(self, reason: str) -> None:
        self.is_chosen = True
        if self.multigrid is None:  # else it was chosen before, and forgotten
            log.info(
                "preconditioner: multigrid on the lattice (%s; -pc_type jacobi keeps to it)", reason
            )
            self.multigrid = self.make_multigrid()

    @property
    def to_balance(self) -> LatticePreconditioner | None:
        """The multigrid that moves free bodies as wholes to where forces balance; None where there is none."""
        multigrid = self.multigrid if self.is_chosen else None
        return multigrid if multigrid and multigrid.translations else None

    def most_iterations(self, rtol: float) -> int | None:
        """Iterations that a linear solve to a relative tolerance is given; None: what PETSc's options say."""
        return self.multigrid.most_iterations(rtol) if self.multigrid and self.is_chosen else None

    def learn(self, its: int, rtol: float, reached: float) -> None:
        """Take note of the iterations that a linear solve took to a relative tolerance, and of what it has reached."""
        if self.multigrid and self.is_chosen:
            self.multigrid.learn(its, rtol)
        elif self.chooses and its * np.log(2 / USUAL) > LONG * np.log(2 / reached):
            self._choose(f"Jacobi's took {its} iterations a solve")

    def setFromOptions(self, _: PETSc.PC) -> None:
        if not self.is_chosen:
            self.in_use.pc.setFromOptions()

    def setUp(self, _: PETSc.PC) -> None:
        self.in_use.pc.setUp()

    def view(self, _: PETSc.PC, viewer: PETSc.Viewer) -> None:
        """Show the preconditioner of A, or multigrid and a table of its levels (PCView calls it)."""
        if self.multigrid and self.is_chosen:
            for line in repr(self.multigrid.multigrid).splitlines():
                viewer.printfASCII(f"    {line}\n")
        self.in_use.pc.view(viewer)

    @property
    def applied(self) -> Preconditioner | LatticePreconditioner:
        return self.for_searches if self.is_searching and self.for_searches else self.in_use

    def apply(self, _: PETSc.PC | None, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.applied.apply(x, y)

    def least_norm(self, r: PETSc.Vec) -> float:
        """Return a lower bound of |r|_(H^-1) that P has no part in: H is no more than 2 D, or 4 D where it changed."""
        columns = self.applied.unknowns.columns(r)
        square = float(np.vdot(columns, self.applied.by_diagonal(columns)))
        return 0.5 * float(np.sqrt(max(self.applied.unknowns.comm.allreduce(square), 0.0)))

    def forget(self) -> None:
        """Forget what earlier steps showed: a preconditioner that was chosen by its iterations is chosen anew."""
        self.is_chosen = self.of_matrix is None
        if self.multigrid:
            self.multigrid.forget()

    def destroy(self, _: PETSc.PC) -> None:
        for owned in (self.of_matrix, self.multigrid, self.for_searches):
            if owned:
                owned.destroy()
