"""Geometric multigrid on a lattice for the true Hessian, as a PCMG.

PETSc's options set levels, smoothers, coarse solve and cycle (-pc_mg_..., -mg_levels_...,
-mg_coarse_...).

The hierarchy uses the projected Hessian H, which is positive definite at any positions. Therefore
CG with the true Hessian has a positive definite preconditioner. The finest level applies H spring
by spring or cell by cell in single precision, with a block diagonal D in its smoother. The first
coarse matrix is also summed over springs or cells (solve.multigrid.galerkin). PETSc computes the
coarser matrices as products P^T H P. P is the same for x, y and z. So PETSc multiplies the nine
entries of the blocks one after the other, as matrices of the nodes. On a CPU all coarse levels
except the coarsest multiply in single precision (solve.multigrid.coarse_products).
"""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from petsc4py import PETSc
from scipy.sparse import bsr_array, csr_array

from msmpetsc.backend.arrays import Indices, Positions, Rows, to_host
from msmpetsc.comm import reduced
from msmpetsc.contact.surface.surface_contact import SurfaceHessian
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.errors import InputError
from msmpetsc.lattice.initial_state import uniform
from msmpetsc.solve.linear.largest_eigenvalue import largest_eigenvalue
from msmpetsc.solve.linear.operators import python_matrix
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.coarse_copies import CoarseCopies
from msmpetsc.solve.multigrid.coarse_products import CoarseOperator
from msmpetsc.solve.multigrid.contact import coarse_contact
from msmpetsc.solve.multigrid.finest_level import DiagonalBlocks, ProjectedHessian
from msmpetsc.solve.multigrid.free_bodies import bodies_of
from msmpetsc.solve.multigrid.galerkin import GalerkinSum
from msmpetsc.solve.multigrid.grids import CoarseGrid, grids, interpolation, node_keys
from msmpetsc.solve.multigrid.interpolation import Interpolation
from msmpetsc.solve.petsc import device
from msmpetsc.solve.petsc.library import (
    petsc_csr,
    replaced_option,
    set_chebyshev,
    set_up_aij,
)

# greatest number of nodes of the coarsest grid, whose matrix is factored; coarser grids
# lose thin limbs
COARSEST = 1000
# the same, over the root of the lattice's number of nodes; the factor of a larger grid
# takes as long as the finest level
COARSEST_ROOT = 9.0
# greatest number of surface points that the finest smoother couples; its matrix is
# dense
POINTS = 200
# lower end of a smoother's range of eigenvalues, over its upper end [-]; coarse grids
# damp the rest
RANGE_START = 0.25
# factor on an eigenvalue estimated by ten CG iterations [-]; the estimate is too small
SAFETY = 1.1
# relative increase of coarse diagonals [-], without and with free bodies; see
# ``_raise_diagonal``
RAISED = 1e-8, 1e-5
# first release of PETSc that restricts by the transpose of a square matrix
TRANSPOSES_SQUARE = (3, 19)


@dataclass(frozen=True)
class Level:
    """Coarse level of multigrid.

    grid          : nodes of the level
    interpolation : P to the next finer level
    scalar        : P (AIJ) of a single coordinate; None for the first coarse level
    pattern       : AIJ of the nodes, with an entry for each block of the level's matrix
    matrix        : the level's matrix (AIJ of block size 3), or its diagonal blocks alone if a
                    CoarseOperator multiplies; none on the coarsest level
    """

    grid: CoarseGrid
    interpolation: Interpolation
    scalar: PETSc.Mat | None
    pattern: PETSc.Mat
    matrix: PETSc.Mat

    @cached_property
    def diagonal(self) -> Indices:
        """Places (n,) of the diagonal blocks in the level's matrix."""
        begin, columns, _ = self.pattern.getValuesCSR()
        own = np.repeat(self.grid.table.first + np.arange(len(begin) - 1), np.diff(begin))
        return np.flatnonzero(columns == own)


class Multigrid:
    """PCMG of a lattice and a time step, with its hierarchy. All methods are collective.

    bodies : bodies of the lattice, each with its own coarse grids
    fine   : operator of the finest level
    pc     : the PCMG, with the options of the ``prefix``
    levels : coarse levels, the finest first
    coarse : single-precision products of all coarse levels except the coarsest; empty on a GPU
    coarsest : coarsest matrix with contact (BAIJ)
    bounds : largest eigenvalue of D^-1 H of each level except the coarsest, the finest first

    Raises InputError for options that do not fit the lattice.
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
        self.coarse: list[CoarseOperator] = []
        self.bounds = [0.0] * len(self.levels)
        self.coarsest = PETSc.Mat()
        self.owned.callback(self.coarsest.destroy)
        self.pc = PETSc.PC().create(unknowns.comm)
        self.owned.callback(self.pc.destroy)

    def follow(self, contact: Rows) -> None:
        """Give the finest level the present contact of each node, (owned, 9) or (0, 9) [N/m].

        D gains the same blocks as H, so that Chebyshev's bound remains valid. Coarse levels keep
        the contact of the last ``update``.
        """
        self.fine.take_contact(contact)
        self.operator.assemble()

    def _create_levels(self, elasticity: Elasticity, t2: float) -> tuple[GalerkinSum, list[Level]]:
        """Return the sum of the first coarse matrix, and the coarse levels without values."""
        unknowns, comm = self.unknowns, self.unknowns.comm
        everywhere = node_keys(unknowns)
        offsets = self.bodies.offsets(comm, everywhere)
        free = to_host(unknowns.free)
        copies = CoarseCopies(unknowns.lattice, everywhere, offsets)
        keys = (everywhere + offsets)[free]
        asked = PETSc.Options(self.prefix).getInt("pc_mg_levels", 0)
        count = max(asked - 1, 1) if asked else None
        coarsest = min(COARSEST, int(COARSEST_ROOT * np.sqrt(unknowns.total)))
        coarse = grids(comm, keys, copies, free, unknowns.total, coarsest, count)
        if asked and asked != len(coarse) + 1:
            nearest = len(coarse) + 1
            raise InputError(
                f"-{self.prefix}pc_mg_levels {asked}: the nearest for this lattice is {nearest}"
            )
        stiff = 1 / self.fine.compliance
        galerkin = GalerkinSum(
            unknowns, elasticity, t2, coarse[0], everywhere, offsets, copies.of_nodes, stiff
        )
        levels: list[Level] = []
        for grid in coarse:
            rows = interpolation(keys, grid)
            p = Interpolation(comm, rows, grid, unknowns.lattice.nodes, not levels)
            scalar, pattern = None, galerkin.pattern
            if levels:
                finer, coarser = len(keys), len(grid.table.keys)
                sizes = (finer, levels[-1].grid.table.total), (coarser, grid.table.total)
                scalar = PETSc.Mat().create(comm)
                set_up_aij(scalar, sizes, unknowns.memory.mat_type, rows)
                self.owned.callback(scalar.destroy)
                pattern = PETSc.Mat()
            levels.append(Level(grid, p, scalar, pattern, PETSc.Mat()))
            for owned in (p.operator, pattern, levels[-1].matrix):
                self.owned.callback(owned.destroy)
            keys = grid.table.keys
        return galerkin, levels

    def update(self, q: Positions, contact: Rows, surface: SurfaceHessian | None = None) -> None:
        """Build the hierarchy at positions q (l, 3) [m].

        contact : (owned, 9) or (0, 9) Hessian of contact of each node [N/m]
        surface : Hessian of surface contact; None without it
        """
        # The stiffest points couple nodes; the remaining points add to diagonal blocks.
        joined, remaining = surface.split(self.fine.compliance, POINTS) if surface else (None, None)
        contact = contact + remaining.blocks if remaining else contact
        self.fine.update(q, contact, joined)
        self.operator.assemble()
        blocks = self.coarse_blocks(q, contact)
        is_new = self.pc.getType() is None
        if is_new and self.unknowns.memory is not device.CUDA:
            self.coarse = [CoarseOperator(level.pattern) for level in self.levels[:-1]]
            for coarse in self.coarse:
                self.owned.callback(coarse.operator.destroy)
        diagonals = [
            of_level[level.diagonal]
            for level, of_level in zip(self.levels, blocks[:-1], strict=False)
        ]
        added = self._contact_at(joined, diagonals) if joined else None
        for i, (level, diagonal) in enumerate(zip(self.levels, diagonals, strict=False)):
            blocks[i][level.diagonal] = diagonal
            if self.coarse:
                self.coarse[i].update(blocks[i])
                begin = np.arange(len(diagonal) + 1)
                columns = level.grid.table.first + begin[:-1]
                set_blocks(level.matrix, level.pattern, begin, columns, diagonal)
            else:
                begin, columns, _ = level.pattern.getValuesCSR()
                set_blocks(level.matrix, level.pattern, begin, columns, blocks[i])
        self._set_coarsest(blocks[-1], added)
        if is_new:
            self._create_cycle()
        self.pc.getMGCoarseSolve().setOperators(self.coarsest, self.coarsest)
        self.bounds[0] = self._finest_bound()
        for i, level in enumerate(self.levels[:-1], 1):
            noise = uniform(level.grid.table.first + np.arange(len(level.grid.table.keys))).ravel()
            matrix = self.coarse[i - 1].operator if self.coarse else level.matrix
            self.bounds[i] = SAFETY * largest_eigenvalue(matrix, noise, of_diagonal=level.matrix)
        for i, bound in enumerate(self.bounds):
            set_chebyshev(self.pc.getMGSmoother(len(self.levels) - i), RANGE_START * bound, bound)
        if is_new:
            self._read_options()

    def _contact_at(self, surface: SurfaceHessian, diagonals: list[Rows]) -> csr_array:
        """Return contact on the coarsest level; add it to the diagonal blocks of other levels."""
        weights, t2 = surface.weights[:, self.unknowns.free], self.fine.t2
        interpolations = [level.interpolation for level in self.levels]
        return coarse_contact(weights, surface, interpolations, t2, diagonals)

    def _set_coarsest(self, blocks: Rows, contact: csr_array | None) -> None:
        """Set the coarsest matrix to its blocks (k, 9), plus this rank's rows of contact."""
        pattern = self.levels[-1].pattern
        begin, columns, _ = pattern.getValuesCSR()
        sizes = 3 * np.array(pattern.getSizes())
        rows = bsr_array((blocks.reshape(-1, 3, 3), columns, begin), (sizes[0, 0], sizes[1, 1]))
        if contact is not None:
            rows = csr_array(rows + contact).tobsr((3, 3))
        indptr, indices = (part.astype(PETSc.IntType) for part in (rows.indptr, rows.indices))
        self.coarsest.destroy()
        # The LU factor in 3 x 3 blocks takes a third of the time of an AIJ's factor.
        self.coarsest.createBAIJ(sizes, 3, csr=(indptr, indices, rows.data), comm=pattern.comm)
        self.coarsest.setVecType(self.unknowns.memory.vec_type)

    @cached_property
    def sizes(self) -> list[tuple[int, int]]:
        """Numbers of nodes and of nonzeros of all levels, the finest first, as if assembled.

        The springs of a lattice count the pairs of nodes in its cells.
        """
        unknowns, lattice = self.unknowns, self.unknowns.lattice.with_springs()
        is_free = unknowns.numbers[to_host(lattice.springs)[: lattice.springs_owned]] >= 0
        pairs = reduced(unknowns.comm, int(is_free.all(axis=1).sum()))
        total = PETSc.Mat.InfoType.GLOBAL_SUM
        coarse = [
            (level.grid.table.total, 9 * int(level.pattern.getInfo(total)["nz_used"]))
            for level in self.levels
        ]
        return [(unknowns.total, 9 * (unknowns.total + 2 * pairs)), *coarse]

    def __repr__(self) -> str:
        """Return a table of the levels, as ``-ksp_view`` shows it."""
        if self.pc.getType() is None:
            return f"multigrid of {1 + len(self.levels)} levels, not built yet"
        nonzeros = [number for _, number in self.sizes]
        complexity = f"operator complexity {sum(nonzeros) / nonzeros[0]:.3f}"
        lines = [f"multigrid of {len(self.sizes)} levels, {complexity}"]
        lines.append(f"{'level':>5} {'nodes':>10} {'nonzeros':>12}")
        numbers = range(len(self.sizes) - 1, -1, -1)
        lines += [
            f"{n:>5} {nodes:>10} {nz:>12}"
            for n, (nodes, nz) in zip(numbers, self.sizes, strict=True)
        ]
        return "\n".join(lines)

    def _finest_bound(self) -> float:
        """Return a bound on the eigenvalues of D^-1 H of the finest level, or an estimate by CG.

        The estimate leaves out the blocks of contact, because they might hide a greater eigenvalue
        of nodes that later lose contact. The blocks are a part of both D and H, so they raise no
        eigenvalue above the estimate.
        """
        bound, unknowns, contact = self.fine.elasticity.bound, self.unknowns, self.fine.contact
        if bound is not None:
            return bound
        noise = uniform(unknowns.numbers[to_host(unknowns.free)]).T.ravel()
        # Surface contact changes only with the next hierarchy
        follows = self.fine.joined is None and len(contact) > 0
        if follows:
            self.fine.take_contact(contact[:0])
        bound = SAFETY * largest_eigenvalue(self.operator, noise, DiagonalBlocks(self.fine))
        if follows:
            self.fine.take_contact(contact)
        return bound

    def coarse_blocks(self, q: Positions, contact: Rows) -> list[Rows]:
        """Return the blocks (k, 9) of the matrix of each coarse level, in the pattern's order.

        contact : (owned, 9) or (0, 9) Hessian of contact of each node [N/m]
        """
        of_pairs, blocks = self.sum.blocks_at(q, contact), list[Rows]()
        for entry in range(9):
            self.sum.set_entries(of_pairs, entry)
            for i, level in enumerate(self.levels):
                if i > 0:
                    self._galerkin_product(self.levels[i - 1].pattern, level)
                if entry % 4 == 0:
                    self._raise_diagonal(level.pattern)
                values = level.pattern.getValuesCSR()[2]
                if entry == 0:
                    blocks.append(np.empty((len(values), 9)))
                blocks[i][:, entry] = values
        return blocks

    def _galerkin_product(self, finer: PETSc.Mat, level: Level) -> None:
        """Compute P^T H P of a level, for the entry of the blocks that ``finer`` has."""
        with ExitStack() as options:
            for name, value in () if level.pattern else self._product_options(finer):
                options.enter_context(replaced_option(name, value))
            finer.ptap(level.scalar, level.pattern)

    def _raise_diagonal(self, matrix: PETSc.Mat) -> None:
        """Increase a diagonal of a coarse matrix by RAISED, to make the matrix positive definite.

        The columns of P are linearly dependent if a coarse cell has few fine nodes. The increase
        acts as springs to the ground. These must be soft for a clamped slender body, because
        bending is soft, too. A free body of negligible mass needs stiffer springs. Otherwise a load
        moves the body so far that single precision loses its shape.
        """
        diagonal = matrix.getDiagonal()
        diagonal.scale(1 + RAISED[int(self.bodies.free.any())])
        matrix.setDiagonal(diagonal)
        diagonal.destroy()

    def _product_options(self, matrix: PETSc.Mat) -> Iterator[tuple[str, str]]:
        """Yield our defaults for PETSc's options of the product P^T H P."""
        given = PETSc.Options().getAll()
        if "matptap_via" not in given:
            # PETSc's default sums messages in their order of arrival, which varies.
            # On one rank rap takes a third of the default's time.
            yield "matptap_via", "allatonce" if matrix.comm.size > 1 else "rap"
        # The product of PETSc 3.26 on an H100 is wrong: it is 0.
        if self.unknowns.memory is device.CUDA and "matptap_backend_cpu" not in given:
            yield "matptap_backend_cpu", "true"

    def _create_cycle(self) -> None:
        """Give the PCMG its levels, interpolations, restrictions and smoothers."""
        pc, top = self.pc, len(self.levels)
        pc.setOptionsPrefix(self.prefix)
        pc.setOperators(self.operator)
        pc.setType(PETSc.PC.Type.MG)
        pc.setMGLevels(top + 1)
        for i, level in enumerate(self.levels):
            pc.setMGInterpolation(top - i, level.interpolation.operator)
            pc.setMGRestriction(top - i, self._restriction(level.interpolation))
        for i, level in enumerate(self.levels[:-1]):
            ksp = pc.getMGSmoother(top - 1 - i)
            operator = self.coarse[i].operator if self.coarse else level.matrix
            ksp.setOperators(operator, level.matrix)
            ksp.getPC().setType(PETSc.PC.Type.PBJACOBI)
        finest = pc.getMGSmoother(top)
        finest.setOperators(self.operator, self.operator)
        finest.getPC().setType(PETSc.PC.Type.PYTHON)
        finest.getPC().setPythonContext(DiagonalBlocks(self.fine))

    def _restriction(self, interpolation: Interpolation) -> PETSc.Mat:
        """Return the restriction P^T as a matrix of its own.

        PETSc tells by the shape whether a matrix restricts or interpolates, which fails for a
        square P. For a square matrix, PETSc 3.22 multiplies by the transpose and PETSc 3.18 by the
        matrix itself. PETSc 3.22 fails for a MATTRANSPOSE as well.
        """
        fine, coarse = interpolation.operator.getSizes()
        is_transposed = fine[1] == coarse[1] and PETSc.Sys.getVersion() >= TRANSPOSES_SQUARE
        shape = (fine, coarse) if is_transposed else (coarse, fine)
        restriction = PETSc.Mat().createPython(
            shape, Restriction(interpolation), comm=self.unknowns.comm
        )
        restriction.setVecType(self.unknowns.memory.vec_type)
        restriction.setUp()
        self.owned.callback(restriction.destroy)
        return restriction

    def _read_options(self) -> None:
        """Read PETSc's options. Raises InputError for a smoother that needs a finest matrix.

        The user's pc_type does not count here, because a system may be exported from a run whose
        steps have another preconditioner.
        """
        options = PETSc.Options(self.prefix)
        for name in ("mg_levels_pc_type", f"mg_levels_{len(self.levels)}_pc_type"):
            if options.hasName(name):
                kind = options.getString(name)
                raise InputError(
                    f"-{self.prefix}{name} {kind}: the finest level has no matrix, but 3 x 3 "
                    "blocks of its own"
                )
        with replaced_option(f"{self.prefix}pc_type", PETSc.PC.Type.MG):
            self.pc.setFromOptions()
            self.pc.setUp()

    def destroy(self) -> None:
        """Destroy all PETSc objects (collective)."""
        self.owned.close()


def set_blocks(
    matrix: PETSc.Mat, pattern: PETSc.Mat, begin: Indices, columns: Indices, blocks: Rows
) -> None:
    """Set a matrix (AIJ of block size 3) to blocks; create a new matrix first (collective).

    pattern : a matrix of the nodes, of the same type
    begin   : (n + 1,) row i has the blocks (k, 9) from begin[i] to begin[i + 1]
    columns : (k,) column of each block
    """
    shape = len(begin) - 1, pattern.getSize()[1]
    rows = bsr_array((blocks.reshape(-1, 3, 3), columns, begin), 3 * np.array(shape)).tocsr()
    if matrix:
        matrix.setValuesCSR(*petsc_csr(rows))
        matrix.assemble()
        return
    matrix.create(pattern.comm)
    set_up_aij(matrix, 3 * np.array(pattern.getSizes()), pattern.getType(), rows, 3)
    matrix.setOption(PETSc.Mat.Option.SPD, True)
    # PETSc gives the diagonal part of a parallel matrix no block size, but pbjacobi
    # inverts it.
    matrix.getDiagonalBlock().setBlockSize(3)


class Restriction:
    """Apply P^T, also as its own transpose (a context of MATPYTHON)."""

    def __init__(self, interpolation: Interpolation):
        self.interpolation = interpolation

    def mult(self, matrix: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.interpolation.multTranspose(matrix, x, y)

    multTranspose = mult
