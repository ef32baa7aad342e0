"""Measurements beside a run's frames: true errors, the iterates of one step, where the time went."""

from dataclasses import dataclass, field
from functools import partial
from time import perf_counter

from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Array, Positions, Rows
from msmpetsc.solve.multigrid.cycle import Multigrid
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.petsc.events import CYCLE, FINE, GRIDS, HIERARCHY, LOCAL, count, seconds

INDEX, VALUE = PETSc.IntType().itemsize, PETSc.ScalarType().itemsize
EVENTS = {
    "factor": ["PCSetUp"], "local": [LOCAL.name], "ksp": ["KSPSolve"], "hierarchy": [GRIDS.name, HIERARCHY.name],
    "cycle": [CYCLE.name], "fine": [FINE.name],
}  # fmt: skip


@dataclass(frozen=True)
class Probes:
    """Probes of a run's steps."""

    true_error: int | None = None  # every so many steps the true error is measured; None for never
    trace: int | None = None  # the step whose iterates are followed; None for none

    def asks(self, index: int) -> bool:
        """Whether the true error of a step is to be measured."""
        return index == self.trace or (self.true_error is not None and index % self.true_error == 0)


@dataclass
class Trace:
    """Iterates of a step: at each its number, the KSP iterations and seconds so far, positions (l, 3) [m]."""

    iteration: list[int] = field(default_factory=list)
    ksp_its: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    positions: list[Positions] = field(default_factory=list)

    def follow(self, stepper: Stepper) -> None:
        """Take the iterates from now on, which is when the step begins."""
        begin, before = perf_counter(), stepper.work_so_far()

        def observe(q: Positions) -> None:
            nonlocal begin
            now = perf_counter()
            self.iteration.append(len(self.iteration))
            self.ksp_its.append((stepper.work_so_far() - before).ksp_its)
            self.seconds.append(now - begin)
            self.positions.append(q)
            begin += perf_counter() - now  # not of the step

        stepper.observer = observe


def times(comm: MPI.Comm) -> dict[str, float]:
    """Seconds in events of the run, those of its references left out, the greatest of all ranks (collective)."""
    return {name: comm.allreduce(sum(map(seconds, events)), MPI.MAX) for name, events in EVENTS.items()}


def hierarchies(comm: MPI.Comm, stepper: Stepper | None) -> dict[str, int]:
    """How many hierarchies of multigrid were built, and bytes of all ranks that the last one holds (collective).

    They are those beside the lattice, without what factors the coarsest level: P and matrix of each
    coarse level, what sums the first, the finest level's blocks.
    """
    own = 0
    chosen = stepper.jacobian.preconditioner.multigrid if stepper else None
    if chosen:
        multigrid = chosen.multigrid
        total = multigrid.sum
        fine = multigrid.fine
        arrays: list[Array] = [total.places, total.diagonal, total.upper, fine.inverse, fine.contact]
        arrays += [*total.springs, *total.nodes, *total.cells, *_blocks(multigrid)]
        own = sum(_of_matrix(matrix) for level in multigrid.levels for matrix in (level.interpolation, level.matrix))
        arrays += [array for coarse in multigrid.coarse for array in (coarse.sums, *coarse.own, *coarse.others)]
        own += sum(array.nbytes for array in arrays)
    return {"builds": count(HIERARCHY.name), "bytes": comm.allreduce(own)}


def _blocks(multigrid: Multigrid) -> list[Rows]:
    """Arrays that the finest level's Hessian has of its own, not of the lattice."""
    hessian = multigrid.fine.elastic
    lent = {id(array) for part in multigrid.fine.elasticity.parts for array in vars(part).values()}
    parts = [part for part in hessian.parts if isinstance(part, partial)] if hessian else []
    return [array for part in parts for array in part.args if hasattr(array, "nbytes") and id(array) not in lent]


def _of_matrix(matrix: PETSc.Mat) -> int:
    """Return bytes of a rank's part of an AIJ matrix; 0 where it is not there yet."""
    if not matrix:
        return 0
    nonzeros = matrix.getInfo(PETSc.Mat.InfoType.LOCAL)["nz_used"]
    return int(nonzeros) * (INDEX + VALUE) + (matrix.getLocalSize()[0] + 1) * INDEX
