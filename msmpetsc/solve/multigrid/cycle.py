"""Multigrid cycle on a lattice's grids for the true Hessian, as a PCMG: levels, smoothers, coarse solve and cycle are
set by PETSc's options (-pc_mg_..., -mg_levels_..., -mg_coarse_...).

The hierarchy is that of the projected Hessian H, which is positive definite at any positions, so that CG on the true
one has a preconditioner that is, too. The finest level is applied spring by spring, the first coarse one is summed so
(solve.multigrid.galerkin), those below are products P^T H P of PETSc's.
"""

from collections.abc import Iterator
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import to_host
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.errors import InputError
from msmpetsc.geometry.grid import decode_morton
from msmpetsc.lattice.initial_state import uniform
from msmpetsc.solve.linear.operators import python_matrix
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.bodies import bodies_of
from msmpetsc.solve.multigrid.fine import DiagonalBlocks, ProjectedHessian
from msmpetsc.solve.multigrid.galerkin import RAISED, GalerkinSum, set_block_size
from msmpetsc.solve.multigrid.grids import CoarseGrid, grid_indices, grids, interpolation
from msmpetsc.solve.petsc import memory
from msmpetsc.solve.petsc.library import replaced_option, set_chebyshev, square_restricts_transposed

COARSEST = 800  # nodes of the grid whose matrix is factored: thin limbs vanish on a coarser one
LEAST = 0.25  # of the greatest eigenvalue of D^-1 H: where a smoother's range begins
FINEST = 2.0  # that eigenvalue on the finest level, at most (elasticity.add_half_bound); thrice for D's own diagonal
SAFETY = 1.1  # times it on a coarser level, as some iterations of CG know it
ITERATIONS = 10  # of these


@dataclass(frozen=True)
class Level:
    """A coarse level: its grid, P from it to the next finer one, and its matrix (AIJ, block size 3)."""

    grid: CoarseGrid
    interpolation: PETSc.Mat
    matrix: PETSc.Mat


class Multigrid:
    """The PCMG of one lattice and time step, and the hierarchy that it works on. All methods are collective.

    bodies : that have coarse grids of their own
    pc     : its options have the ``prefix``
    levels : the coarse ones, the finest of them first
    """

    def __init__(self, comm: MPI.Comm, unknowns: Unknowns, elasticity: Elasticity, time_step: float, prefix: str):
        self.unknowns, self.prefix, self.owned = unknowns, prefix, ExitStack()
        self.bodies = bodies_of(comm, unknowns)
        self.fine = ProjectedHessian(unknowns, elasticity, time_step**2)
        self.operator = python_matrix(unknowns, self.fine, comm)
        self.owned.callback(self.operator.destroy)
        try:
            self.sum, self.levels = self._create_levels(comm, elasticity, time_step**2)
        except InputError:
            self.owned.close()
            raise
        smoother = PETSc.Options(prefix).getString("mg_levels_pc_type", "")
        self.bounds = [FINEST * (3 if smoother == PETSc.PC.Type.JACOBI else 1)] + [0.0] * (len(self.levels) - 1)
        self.pc = PETSc.PC().create(comm)
        self.owned.callback(self.pc.destroy)

    def _create_levels(self, comm: MPI.Comm, elasticity: Elasticity, t2: float) -> tuple[GalerkinSum, list[Level]]:
        unknowns = self.unknowns
        size, everywhere = unknowns.size, grid_indices(unknowns)
        apart = self.bodies.apart(comm, everywhere)
        ijk = (everywhere + [1, 0, 0] * apart[:, None])[to_host(unknowns.free)]
        asked = PETSc.Options(self.prefix).getInt("pc_mg_levels", 0)
        coarse = grids(comm, ijk, unknowns.total, COARSEST, asked - 1 if asked > 1 else None)
        if asked and asked != len(coarse) + 1:
            raise InputError(f"-{self.prefix}pc_mg_levels {asked}: this lattice has {_possible(asked, len(coarse))}")
        galerkin = GalerkinSum(comm, unknowns, elasticity, t2, coarse[0], everywhere, apart)
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

    def update(self, q: np.ndarray, contact: np.ndarray) -> None:
        """Build the hierarchy at positions q (l, 3) [m]; ``contact`` (owned, 9), or (0, 9), of the nodes [N/m]."""
        self.fine.update(q, contact)
        self.operator.assemble()
        self.sum.update(q, contact)
        for finer, level in zip(self.levels, self.levels[1:], strict=False):
            self._galerkin_product(finer, level)
        is_new = self.pc.getType() is None
        if is_new:
            self._create_cycle()
        for i, level in enumerate(self.levels[:-1], 1):
            self.bounds[i] = SAFETY * greatest_eigenvalue(level)
        for i, bound in enumerate(self.bounds):
            set_chebyshev(self.pc.getMGSmoother(len(self.levels) - i), LEAST * bound, bound)
        if is_new:
            self._read_options()

    def _galerkin_product(self, finer: Level, level: Level) -> None:
        """P^T H P, its diagonal raised as that of the first one is."""
        is_new = not level.matrix
        with ExitStack() as options:
            for name, value in self._product_options(finer.matrix) if is_new else ():
                options.enter_context(replaced_option(name, value))
            finer.matrix.ptap(level.interpolation, level.matrix)
        if is_new:
            set_block_size(level.matrix)
            level.matrix.setOption(PETSc.Mat.Option.SPD, True)
        diagonal = level.matrix.getDiagonal()
        diagonal.scale(RAISED)
        level.matrix.setDiagonal(diagonal)
        diagonal.destroy()

    def _product_options(self, matrix: PETSc.Mat) -> Iterator[tuple[str, str]]:
        """PETSc's options of the product P^T H P that are ours, where the user gives none."""
        given = PETSc.Options().getAll()
        if matrix.comm.size > 1 and "matptap_via" not in given:
            yield "matptap_via", "allatonce"  # the default adds what other ranks send as it comes in: no two runs alike
        if self.unknowns.memory is memory.CUDA and "matptap_backend_cpu" not in given:
            yield "matptap_backend_cpu", "true"  # on an H100 PETSc 3.26's own product of two sparse matrices was 0

    def _create_cycle(self) -> None:
        """Make PCMG know the levels."""
        pc, top = self.pc, len(self.levels)
        pc.setOptionsPrefix(self.prefix)
        pc.setOperators(self.operator)
        pc.setType(PETSc.PC.Type.MG)
        pc.setMGLevels(top + 1)
        for i, level in enumerate(self.levels):
            pc.setMGInterpolation(top - i, level.interpolation)
            pc.setMGRestriction(top - i, self._restriction(level.interpolation))
            ksp = pc.getMGSmoother(top - 1 - i) if i < top - 1 else pc.getMGCoarseSolve()
            ksp.setOperators(level.matrix, level.matrix)
            ksp.getPC().setType(PETSc.PC.Type.PBJACOBI)
        finest = pc.getMGSmoother(top)
        finest.setOperators(self.operator, self.operator)
        finest.getPC().setType(PETSc.PC.Type.PYTHON)
        finest.getPC().setPythonContext(DiagonalBlocks(self.fine))

    def _restriction(self, interpolation: PETSc.Mat) -> PETSc.Mat:
        """P^T, or what PETSc takes for it: by its shape alone it cannot tell a square P."""
        rows, columns = interpolation.getSizes()
        if rows[1] == columns[1] and square_restricts_transposed():
            return interpolation
        restriction = PETSc.Mat().createTranspose(interpolation)
        self.owned.callback(restriction.destroy)
        return restriction

    def _read_options(self) -> None:
        """Follow PETSc's options; the user's win. A preset's may say what it begins with, not that it is a PCMG. The
        finest level's blocks are the only pbjacobi of a matrix that is not assembled."""
        levels = f"{self.prefix}mg_levels_"
        is_blocks = PETSc.Options().getString(f"{levels}pc_type", "") == PETSc.PC.Type.PBJACOBI
        finest = replaced_option(f"{levels}{len(self.levels)}_pc_type", PETSc.PC.Type.PYTHON)
        with replaced_option(f"{self.prefix}pc_type", PETSc.PC.Type.MG), finest if is_blocks else nullcontext():
            self.pc.setFromOptions()
            self.pc.setUp()

    def destroy(self) -> None:
        self.owned.close()


def _possible(asked: int, coarse: int) -> str:
    return "two levels or more" if asked < 2 else f"{coarse + 1} at most, for a coarser grid would not be much smaller"


def greatest_eigenvalue(level: Level) -> float:
    """Return about the greatest eigenvalue of D^-1 H of a level, D its 3 x 3 diagonal blocks (collective)."""
    x, b = level.matrix.createVecs()
    first = level.grid.table.first
    b.array[:] = uniform(first + np.arange(len(level.grid.table.keys))).ravel() - 0.5
    ksp = PETSc.KSP().create(level.matrix.comm)
    ksp.setType(PETSc.KSP.Type.CG)
    ksp.setOperators(level.matrix)
    ksp.getPC().setType(PETSc.PC.Type.PBJACOBI)
    ksp.setComputeEigenvalues(True)
    ksp.setTolerances(max_it=ITERATIONS, rtol=np.finfo(float).eps)
    ksp.solve(b, x)
    greatest = ksp.computeExtremeSingularValues()[0]
    for owned in (ksp, x, b):
        owned.destroy()
    return greatest
