"""Linear systems of chosen steps as PETSc's binary files, for other solvers."""

import json
from collections.abc import Sequence
from copy import copy
from pathlib import Path
from time import perf_counter
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import to_host
from msmpetsc.comm import log, on_root
from msmpetsc.results.disk import plain_errors, write_whole
from msmpetsc.solve.linear.assembled_hessian import assembled, blocks_of
from msmpetsc.solve.linear.operators import python_matrix
from msmpetsc.solve.nonlinear.functional import Iterate
from msmpetsc.solve.nonlinear.jacobian import Jacobian
from msmpetsc.solve.petsc.library import petsc_errors

# relative residuals |F - H y| / |F| of the timed solve and of the stored correction [-]
TIMED, EXACT = 1e-8, 1e-12


class ExportedSystems:
    """Writer of the first linear system H y = F of chosen steps. All methods are collective.

    A folder step_N gets hessian.bin, residual.bin, coordinates.bin, rigid_modes.bin (six
    vectors), correction.bin and system.json. Rows are by node: x, y and z of a node in sequence.

    steps : numbers of the steps, from 1, still to be written

    Raises InputError if the folder cannot be written.
    """

    def __init__(self, comm: MPI.Intracomm, folder: Path, steps: Sequence[int]):
        self.comm, self.folder, self.steps = comm, folder, set(steps)
        on_root(comm, lambda: _make(folder))

    def __call__(self, step: int, now: Iterate, jacobian: Jacobian) -> None:
        """Write the system at an iterate, if it is the first system of a chosen step."""
        if step not in self.steps:
            return
        self.steps.remove(step)
        folder, unknowns = self.folder / f"step_{step}", jacobian.unknowns
        on_root(self.comm, lambda: _make(folder))
        matrix = assembled(unknowns, blocks_of(jacobian.hessian))
        right, coordinates, correction = (matrix.createVecLeft() for _ in range(3))
        y = now.x.duplicate()
        cost = _solved(now, jacobian, y)
        for vector, given in ((right, now.f), (correction, y)):
            vector.array[:] = to_host(unknowns.columns(given)).T.ravel()
        coordinates.array[:] = to_host(now.q[unknowns.free]).ravel()
        rigid = PETSc.NullSpace().createRigidBody(coordinates)
        files = {
            "hessian": [matrix],
            "residual": [right],
            "coordinates": [coordinates],
            "correction": [correction],
            "rigid_modes": rigid.getVecs(),
        }
        for name, objects in files.items():
            _write(self.comm, folder / f"{name}.bin", objects)
        nonzeros = int(matrix.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"])
        sizes = {"step": step, "nodes": unknowns.total, "nonzeros": nonzeros}
        facts = json.dumps(sizes | {"ranks": self.comm.size, "multigrid": cost}, indent=1)
        on_root(self.comm, lambda: write_whole(folder / "system.json", facts + "\n"))
        for owned in (rigid, matrix, right, coordinates, correction, y):
            owned.destroy()
        log.info("step %d: its first linear system is in %s", step, folder)

    def sum_up(self) -> None:
        """Warn of chosen steps without a system."""
        if self.steps:
            numbers = ", ".join(map(str, sorted(self.steps)))
            log.warning("no linear system was solved in step %s, so none is exported", numbers)


def _make(folder: Path) -> None:
    with plain_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)


def _write(comm: MPI.Intracomm, path: Path, objects: Sequence[PETSc.Object]) -> None:
    """Write objects one after another as a PETSc binary file. Raises InputError."""
    with petsc_errors(f"{path} cannot be written"):
        viewer = PETSc.Viewer().createBinary(str(path), "w", comm)
        for each in objects:
            each.view(viewer)
        viewer.destroy()


def _solved(now: Iterate, jacobian: Jacobian, y: PETSc.Vec) -> dict[str, Any]:
    """Solve H y = F to EXACT by CG with our multigrid; return the cost of a solve to TIMED.

    This is a second CG, because the step's CG may have another preconditioner and counts its
    iterations (collective).
    """
    multigrid = jacobian.multigrid()
    ksp = PETSc.KSP().create(jacobian.comm)
    operator = python_matrix(jacobian.unknowns, copy(jacobian.hessian), jacobian.comm)
    ksp.setOperators(operator)
    ksp.setType(PETSc.KSP.Type.CG)
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.getPC().setType(PETSc.PC.Type.PYTHON)
    ksp.getPC().setPythonContext(multigrid)
    rough, cost = y.duplicate(), {}
    # the timed solve comes second, when all kernels are loaded
    for rtol, solution in ((EXACT, y), (TIMED, rough)):
        multigrid.forget()
        began = perf_counter()
        multigrid.prepare(now.q, now.contact)
        ready = perf_counter()
        ksp.setTolerances(rtol=rtol)
        ksp.solve(now.f, solution)
        cost = {
            "iterations": ksp.its,
            "set_up": ready - began,
            "seconds": perf_counter() - ready,
            "status": "ok" if ksp.reason > 0 else "failed",
        }
    for owned in (ksp, operator, rough):
        owned.destroy()
    return cost
