"""Multigrid cycle on a lattice's grids for the true Hessian, as a PCMG: levels, smoothers, coarse
solve and cycle are set by PETSc's options (-pc_mg_..., -mg_levels_..., -mg_coarse_...).

The hierarchy is that of the projected Hessian H, which is positive definite at any positions, so that CG on the true
one has a preconditioner that is, too. The finest level is applied spring by spring or cell by cell in single precision,
and smoothed with a block diagonal D. The first coarse one is summed spring by spring or cell by cell
(solve.multigrid.galerkin), those below are products P^T H P of PETSc's; all but the coarsest are applied in single
precision, too (solve.multigrid.coarse_operator).
"""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from petsc4py import PETSc

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows, to_host
from msmpetsc.backend.kernel import kernel
from msmpetsc.contact.surface.term import SurfaceHessian
from msmpetsc.elasticity.energy import Elasticity, Hessian
from msmpetsc.errors import InputError
from msmpetsc.geometry.grid import decode_morton
from msmpetsc.lattice.initial_state import uniform
from msmpetsc.solve.linear.operators import python_matrix
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.coarse_operator import CoarseOperator
from msmpetsc.solve.multigrid.contact import CoarseContact, ContactSmoother
from msmpetsc.solve.multigrid.free_bodies import bodies_of
from msmpetsc.solve.multigrid.galerkin import GalerkinSum, set_block_size
from msmpetsc.solve.multigrid.grids import CoarseGrid, grid_indices, grids, interpolation
from msmpetsc.solve.petsc import device
from msmpetsc.solve.petsc.events import FINE
from msmpetsc.solve.petsc.library import replaced_option, set_chebyshev

COARSEST = 800  # nodes of the grid whose matrix is factored: thin limbs vanish on a coarser one
POINTS = 200  # of the surface in contact, that join nodes of the finest level: the stiffest
LEAST = 0.25  # of the greatest eigenvalue of D^-1 H: where a smoother's range begins
SAFETY = 1.1  # times it where no bound is known, as ten iterations of CG know it
RAISED = 1e-8, 1e-5  # of themselves: coarse diagonals, where all bodies are held and where not
TRANSPOSES_SQUARE = (3, 19)  # PETSc from here on restricts by the transpose of a square matrix


@dataclass(frozen=True)
class Level:
    """Coarse level: its grid, P from it to the next finer one, its matrix (AIJ, block size 3)."""

    grid: CoarseGrid
    interpolation: PETSc.Mat
    matrix: PETSc.Mat


class Multigrid:
    """The PCMG of one lattice and time step, and the hierarchy that it works on. All methods are collective.

    bodies : that have coarse grids of their own
    pc     : its options have the ``prefix``
    levels : the coarse ones, the finest of them first
    coarse : products with the matrix of each of them but the last; none on a GPU, where PETSc's serve
    sizes  : nodes and nonzeros of all levels, the finest first, which would have so many; empty before ``update``
    """

    def __init__(self, unknowns: Unknowns, elasticity: Elasticity, time_step: float, prefix: str):
        self.unknowns, self.prefix, self.owned = unknowns, prefix, ExitStack()
        self.bodies = bodies_of(unknowns)
        self.fine = ProjectedHessian(unknowns, elasticity, time_step**2)
        self.operator = python_matrix(unknowns, self.fine, unknowns.comm)
        self.owned.callback(self.operator.destroy)
        try:
            self.sum, self.levels = self._create_levels(elasticity, time_step**2)
        except InputError:
            self.owned.close()
            raise
        self.coarse: list[CoarseOperator] = []  # until ``update``
        self.sizes: list[tuple[int, int]] = []
        self.bounds = [0.0] * len(self.levels)
        self.contact = CoarseContact(
            unknowns, [level.interpolation for level in self.levels], time_step**2
        )
        self.owned.callback(self.contact.destroy)
        self.pc = PETSc.PC().create(unknowns.comm)
        self.owned.callback(self.pc.destroy)

    def _create_levels(self, elasticity: Elasticity, t2: float) -> tuple[GalerkinSum, list[Level]]:
        unknowns, comm = self.unknowns, self.unknowns.comm
        size, everywhere = unknowns.size, grid_indices(unknowns)
        apart = self.bodies.offsets(comm, everywhere)
        ijk = (everywhere + [1, 0, 0] * apart[:, None])[to_host(unknowns.free)]
        asked = PETSc.Options(self.prefix).getInt("pc_mg_levels", 0)
        coarse = grids(comm, ijk, unknowns.total, COARSEST, max(asked - 1, 1) if asked else None)
        if asked and asked != len(coarse) + 1:
            raise InputError(
                f"-{self.prefix}pc_mg_levels {asked}: the nearest for this lattice is {len(coarse) + 1}"
            )
        galerkin = GalerkinSum(unknowns, elasticity, t2, coarse[0], everywhere, apart)
        rows, sizes = np.arange(size)[:, None] + size * np.arange(3), (3 * size, 3 * unknowns.total)
        levels: list[Level] = []
        for grid in coarse:
            p = interpolation(comm, ijk, rows, sizes, grid, unknowns.memory.mat_type)
            self.owned.callback(p.destroy)
            levels.append(Level(grid, p, PETSc.Mat() if levels else galerkin.matrix))
            self.owned.callback(levels[-1].matrix.destroy)
            ijk, sizes = decode_morton(grid.table.keys), grid.sizes
            rows = 3 * np.arange(len(ijk))[:, None] + np.arange(3)
        return galerkin, levels

    def update(self, q: Positions, contact: Rows, surface: SurfaceHessian | None = None) -> None:
        """Build the hierarchy at positions q (l, 3) [m]; ``contact`` (owned, 9), or (0, 9), of the nodes [N/m].

        surface : contact of the surface with itself
        """
        joined, others = surface.split(self.fine.compliance, POINTS) if surface else (None, None)
        contact = contact + others.blocks if others else contact
        self.fine.update(q, contact, joined)
        self.operator.assemble()
        self.sum.update(q, contact)
        self._raise_diagonal(self.sum.matrix)
        for finer, level in zip(self.levels, self.levels[1:], strict=False):
            self._galerkin_product(finer, level)
            self._raise_diagonal(level.matrix)
        coarsest = self.contact.added([level.matrix for level in self.levels], joined)
        is_new = self.pc.getType() is None
        if is_new and self.unknowns.memory is not device.CUDA:
            self.coarse = [CoarseOperator(level.matrix) for level in self.levels[:-1]]
            for coarse in self.coarse:
                self.owned.callback(coarse.operator.destroy)
        for coarse in self.coarse:
            coarse.update()
        if is_new:
            self._create_cycle()
        self.pc.getMGCoarseSolve().setOperators(coarsest, coarsest)
        self.bounds[0] = self._finest_bound()
        for i, level in enumerate(self.levels[:-1], 1):
            noise = uniform(level.grid.table.first + np.arange(len(level.grid.table.keys))).ravel()
            self.bounds[i] = SAFETY * greatest_eigenvalue(level.matrix, noise)
        for i, bound in enumerate(self.bounds):
            set_chebyshev(self.pc.getMGSmoother(len(self.levels) - i), LEAST * bound, bound)
        if is_new:
            self._read_options()
            self.sizes = self._sizes()

    def _sizes(self) -> list[tuple[int, int]]:
        """Return the nodes and the nonzeros of all levels, the finest first (collective)."""
        unknowns, lattice = self.unknowns, self.unknowns.lattice
        is_free = unknowns.numbers[to_host(lattice.springs)[: lattice.springs_owned]] >= 0
        pairs = unknowns.comm.allreduce(int(is_free.all(axis=1).sum()))
        total = PETSc.Mat.InfoType.GLOBAL_SUM
        coarse = [
            (level.grid.table.total, int(level.matrix.getInfo(total)["nz_used"]))
            for level in self.levels
        ]
        return [(unknowns.total, 9 * (unknowns.total + 2 * pairs)), *coarse]

    def __repr__(self) -> str:
        """Return a table of the levels, as ``-ksp_view`` shows it."""
        if not self.sizes:
            return f"multigrid of {1 + len(self.levels)} levels, not built yet"
        nonzeros = [number for _, number in self.sizes]
        lines = [
            f"multigrid of {len(self.sizes)} levels, operator complexity {sum(nonzeros) / nonzeros[0]:.3f}"
        ]
        lines.append(f"{'level':>5} {'nodes':>10} {'nonzeros':>12}")
        numbers = range(len(self.sizes) - 1, -1, -1)
        lines += [
            f"{n:>5} {nodes:>10} {nz:>12}"
            for n, (nodes, nz) in zip(numbers, self.sizes, strict=True)
        ]
        return "\n".join(lines)

    def _finest_bound(self) -> float:
        """Greatest eigenvalue of D^-1 H on the finest level, at most, or as some iterations of CG know it."""
        bound, unknowns = self.fine.elasticity.bound, self.unknowns
        if bound is not None:
            return bound
        noise = uniform(unknowns.numbers[to_host(unknowns.free)]).T.ravel()
        return SAFETY * greatest_eigenvalue(self.operator, noise, DiagonalBlocks(self.fine))

    def _galerkin_product(self, finer: Level, level: Level) -> None:
        """P^T H P."""
        is_new = not level.matrix
        with ExitStack() as options:
            for name, value in self._product_options(finer.matrix) if is_new else ():
                options.enter_context(replaced_option(name, value))
            finer.matrix.ptap(level.interpolation, level.matrix)
        if is_new:
            set_block_size(level.matrix)
            level.matrix.setOption(PETSc.Mat.Option.SPD, True)

    def _raise_diagonal(self, matrix: PETSc.Mat) -> None:
        """Few fine nodes in a coarse cell leave its columns linearly dependent.

        What is added holds coarse nodes to the ground, and a slender body resists its load by no more than that. A free
        one without mass needs it: a load moves it so far that single precision has no digits for its shape.
        """
        diagonal = matrix.getDiagonal()
        diagonal.scale(1 + RAISED[int(self.bodies.free.any())])
        matrix.setDiagonal(diagonal)
        diagonal.destroy()

    def _product_options(self, matrix: PETSc.Mat) -> Iterator[tuple[str, str]]:
        """PETSc's options of the product P^T H P that are ours, where the user gives none."""
        given = PETSc.Options().getAll()
        if matrix.comm.size > 1 and "matptap_via" not in given:
            yield (
                "matptap_via",
                "allatonce",
            )  # the default adds what other ranks send as it comes in: no two runs alike
        if self.unknowns.memory is device.CUDA and "matptap_backend_cpu" not in given:
            yield (
                "matptap_backend_cpu",
                "true",
            )  # on an H100 PETSc 3.26's own product of two sparse matrices was 0

    def _create_cycle(self) -> None:
        pc, top = self.pc, len(self.levels)
        pc.setOptionsPrefix(self.prefix)
        pc.setOperators(self.operator)
        pc.setType(PETSc.PC.Type.MG)
        pc.setMGLevels(top + 1)
        for i, level in enumerate(self.levels):
            pc.setMGInterpolation(top - i, level.interpolation)
            pc.setMGRestriction(top - i, self._restriction(level.interpolation))
            ksp = pc.getMGSmoother(top - 1 - i) if i < top - 1 else pc.getMGCoarseSolve()
            ksp.setOperators(
                self.coarse[i].operator if i < len(self.coarse) else level.matrix, level.matrix
            )
            ksp.getPC().setType(PETSc.PC.Type.PBJACOBI)
        finest = pc.getMGSmoother(top)
        finest.setOperators(self.operator, self.operator)
        finest.getPC().setType(PETSc.PC.Type.PYTHON)
        finest.getPC().setPythonContext(DiagonalBlocks(self.fine))

    def _restriction(self, interpolation: PETSc.Mat) -> PETSc.Mat:
        """P^T by itself: of a square P PETSc cannot tell by its shape, nor PETSc 3.22 of a MATTRANSPOSE of one.

        To restrict by a square matrix, PETSc 3.22 multiplies by its transpose, 3.18 by itself.
        """
        fine, coarse = interpolation.getSizes()
        is_transposed = fine[1] == coarse[1] and PETSc.Sys.getVersion() >= TRANSPOSES_SQUARE
        shape = (fine, coarse) if is_transposed else (coarse, fine)
        restriction = PETSc.Mat().createPython(
            shape, Restriction(interpolation), comm=interpolation.comm
        )
        restriction.setVecType(self.unknowns.memory.vec_type)
        restriction.setUp()
        self.owned.callback(restriction.destroy)
        return restriction

    def _read_options(self) -> None:
        """Follow PETSc's options; the user's win. A preset's may say what it begins with, not that it is a PCMG."""
        options = PETSc.Options(self.prefix)
        for name in ("mg_levels_pc_type", f"mg_levels_{len(self.levels)}_pc_type"):
            if options.hasName(name):
                kind = options.getString(name)
                raise InputError(
                    f"-{self.prefix}{name} {kind}: the finest level has no matrix, but 3 x 3 blocks of its own"
                )
        with replaced_option(f"{self.prefix}pc_type", PETSc.PC.Type.MG):
            self.pc.setFromOptions()
            self.pc.setUp()

    def destroy(self) -> None:
        self.owned.close()


def greatest_eigenvalue(
    matrix: PETSc.Mat, noise: Floats, blocks: "DiagonalBlocks | None" = None
) -> float:
    """Return about the greatest eigenvalue of D^-1 H of a level, D its 3 x 3 diagonal blocks (collective).

    noise  : (n,) of this rank, from 0 to 1
    blocks : D^-1 where H is not assembled
    """
    x, b = matrix.createVecs()
    b.array[:] = noise - 0.5
    ksp = PETSc.KSP().create(matrix.comm)
    ksp.setType(PETSc.KSP.Type.CG)
    ksp.setOperators(matrix)
    ksp.getPC().setType(PETSc.PC.Type.PYTHON if blocks else PETSc.PC.Type.PBJACOBI)
    if blocks:
        ksp.getPC().setPythonContext(blocks)
    ksp.setComputeEigenvalues(True)
    ksp.setTolerances(max_it=10, rtol=np.finfo(float).eps)
    ksp.solve(b, x)
    greatest = float(ksp.computeExtremeSingularValues()[0])
    for owned in (ksp, x, b):
        owned.destroy()
    return greatest


class Restriction:
    """P^T whichever way it is applied (a context of MATPYTHON)."""

    def __init__(self, interpolation: PETSc.Mat):
        self.interpolation = interpolation

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.interpolation.multTranspose(x, y)

    multTranspose = mult


class ProjectedHessian:
    """H = M + t^2 (projected Hessian of E, and of contact) at the positions that the hierarchy was built at.

    It is positive definite whatever these are (a context of MATPYTHON).

    products : so far
    """

    def __init__(self, unknowns: Unknowns, elasticity: Elasticity, t2: float):
        self.unknowns, self.elasticity, self.t2 = unknowns, elasticity, t2
        lattice = unknowns.lattice
        self.v = np.zeros_like(lattice.nodes, dtype=np.float32)  # pinned nodes stay zero
        self.product = np.empty_like(self.v)
        self.elastic: Hessian | None = None  # until ``update``
        self.products = 0
        self.contact = np.empty((0, 9), like=lattice.nodes)
        self.inverse = np.empty((unknowns.size, 9), np.float32, like=lattice.nodes)
        blocks = np.zeros((len(lattice.nodes), 9), like=lattice.nodes)
        elasticity.add_bound(lattice.nodes, blocks)
        self.compliance = 1 / (
            unknowns.ballast / t2 + blocks[: lattice.owned, [0, 4, 8]].sum(axis=1) / 3
        )
        self.joined: SurfaceHessian | None = None
        self.smoother: ContactSmoother | None = None

    def update(self, q: Positions, contact: Rows, joined: SurfaceHessian | None = None) -> None:
        """Take the Hessian at positions q (l, 3) [m]; ``contact`` (owned, 9), or (0, 9), of the nodes [N/m].

        joined : of the surface's contact with itself
        """
        self.elastic, self.contact = (
            self.elasticity.hessian_at(q, projected=True, dtype=np.float32),
            contact,
        )
        unknowns, blocks = self.unknowns, np.zeros((len(q), 9), like=q)
        self.elasticity.add_bound(q, blocks)
        nodes = FreeNodes(unknowns.free, unknowns.ballast, contact, self.t2)
        invert_blocks(unknowns.size, self.inverse, blocks, nodes)
        self.joined = joined
        self.smoother = (
            ContactSmoother(self.unknowns, joined, self.t2, self.inverse) if joined else None
        )

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = H x."""
        assert self.elastic is not None, "the hierarchy was not built"
        self.products += 1
        with FINE:
            self.unknowns.to_nodes(x, self.v)
            self.product[:] = 0
            self.elastic.add_product(self.v, self.product)
            if len(self.contact):
                add_node_blocks(len(self.contact), self.contact, self.v, self.product)
            if self.joined:
                self.joined.add_product(self.v, self.product)
            self.unknowns.scaled_sum(self.v, self.t2, self.product, y)

    def by_blocks(self, x: Rows, y: Rows) -> Rows:
        """Write D^-1 x (3, m) into y, and return it; D the 3 x 3 diagonal blocks of H."""
        apply_blocks(self.unknowns.size, x, self.inverse, y)
        if self.smoother:
            self.smoother.correct(y)
        return y


class DiagonalBlocks:
    """Inverse of the 3 x 3 diagonal blocks of the finest level (a context of PCPYTHON)."""

    def __init__(self, hessian: ProjectedHessian):
        self.hessian = hessian

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        unknowns = self.hessian.unknowns
        self.hessian.by_blocks(unknowns.columns(x), unknowns.columns_to_write(y))

    def view(self, _: PETSc.PC, viewer: PETSc.Viewer) -> None:
        viewer.printfASCII("  the 3 x 3 blocks of each node, inverted\n")


@kernel
def add_node_blocks(
    first: int, count: int, step: int, blocks: Rows, v: Array, product: Array
) -> None:
    for i in range(first, count, step):
        for r in range(3):
            for c in range(3):
                product[i, r] += blocks[i, 3 * r + c] * v[i, c]


@kernel
def apply_blocks(first: int, count: int, step: int, x: Rows, inverse: Array, y: Rows) -> None:
    for i in range(first, count, step):
        a, b, c = x[0, i], x[1, i], x[2, i]
        for r in range(3):
            y[r, i] = inverse[i, 3 * r] * a + inverse[i, 3 * r + 1] * b + inverse[i, 3 * r + 2] * c


class FreeNodes(NamedTuple):
    """The unknowns (m,) of a step: their nodes, mass and contact (owned, 9), or (0, 9), of all nodes, t^2 [s^2]."""

    free: Indices
    mass: Floats
    contact: Rows
    t2: float


@kernel
def invert_blocks(
    first: int, count: int, step: int, inverse: Array, blocks: Rows, nodes: FreeNodes
) -> None:
    free, mass, contact, t2 = nodes
    for i in range(first, count, step):
        node = free[i]
        m, d = mass[node], blocks[node]
        a, b, c = t2 * d[0], t2 * d[1], t2 * d[2]
        e, f, g = t2 * d[4], t2 * d[5], t2 * d[8]
        if len(contact):
            p = contact[node]
            a, b, c, e, f, g = (
                a + t2 * p[0],
                b + t2 * p[1],
                c + t2 * p[2],
                e + t2 * p[4],
                f + t2 * p[5],
                g + t2 * p[8],
            )
        a, e, g = a + m, e + m, g + m
        u, v, w = e * g - f * f, c * f - b * g, b * f - c * e
        over = 1.0 / (a * u + b * v + c * w)
        inverse[i, 0], inverse[i, 1], inverse[i, 2] = over * u, over * v, over * w
        inverse[i, 3], inverse[i, 4], inverse[i, 5] = (
            over * v,
            over * (a * g - c * c),
            over * (b * c - a * f),
        )
        inverse[i, 6], inverse[i, 7], inverse[i, 8] = (
            over * w,
            over * (b * c - a * f),
            over * (a * e - b * b),
        )
