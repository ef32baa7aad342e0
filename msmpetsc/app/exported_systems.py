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
from msmpetsc.comm import log, on_root, together
from msmpetsc.errors import InputError
from msmpetsc.results.disk import plain_errors, write_whole
from msmpetsc.scene.reading import Scene
from msmpetsc.scene.schema import held_by
from msmpetsc.solve.linear.assembled_hessian import assembled, blocks_of, subdomain
from msmpetsc.solve.linear.operators import python_matrix
from msmpetsc.solve.nonlinear.functional import Iterate
from msmpetsc.solve.nonlinear.jacobian import Jacobian
from msmpetsc.solve.nonlinear.preconditioning import MULTIGRID, StepPreconditioner
from msmpetsc.solve.petsc.library import petsc_errors

# |F - H y| over |F| at which our multigrid is timed, and that of the correction [-]
TIMED, EXACT = 1e-8, 1e-12


class ExportedSystems:
    """Writer of the first linear system H y = F of chosen steps. All methods are collective.

    A folder step_N gets hessian.bin, residual.bin, coordinates.bin, rigid_modes.bin (six
    vectors), correction.bin and system.json. Rows are by node: x, y and z of a node in sequence.
    On several ranks, subdomain_R.bin has the part of rank R and its rows.

    steps : numbers of the steps, from 1, that are not written yet

    Raises InputError if the folder cannot be written, or for a scene whose Hessian has terms that
    the exported matrix lacks.
    """

    def __init__(self, comm: MPI.Intracomm, scene: Scene, folder: Path, steps: Sequence[int]):
        self.comm, self.folder, self.steps = comm, folder, set(steps)
        with together(comm):
            _refuse_terms(scene)
        on_root(comm, lambda: _make(folder))

    def __call__(self, step: int, now: Iterate, jacobian: Jacobian) -> None:
        """Write the system at an iterate, if it is the first system of a chosen step."""
        if step not in self.steps:
            return
        self.steps.remove(step)
        folder, columns = self.folder / f"step_{step}", jacobian.unknowns.columns
        on_root(self.comm, lambda: _make(folder))
        blocks = blocks_of(jacobian.hessian)
        matrix = assembled(jacobian.unknowns, blocks)
        right, coordinates, correction = (matrix.createVecLeft() for _ in range(3))
        y, rough = now.x.duplicate(), now.x.duplicate()
        _solved(now, jacobian, EXACT, y)
        # Timed second, when all kernels are loaded
        cost = _solved(now, jacobian, TIMED, rough)
        for vector, given in ((right, now.f), (coordinates, now.x), (correction, y)):
            vector.array[:] = to_host(columns(given)).T.ravel()
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
        # The surface's contact with itself is no sum over the ranks' subdomains
        has_subdomains = self.comm.size > 1 and jacobian.hessian.surface is None
        if has_subdomains:
            with together(self.comm):
                _write(MPI.COMM_SELF, folder / f"subdomain_{self.comm.rank}.bin", subdomain(blocks))
        nonzeros = int(matrix.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"])
        sizes: dict[str, Any] = {
            "step": step,
            "nodes": jacobian.unknowns.total,
            "nonzeros": nonzeros,
        }
        sizes |= {"ranks": self.comm.size, "subdomains": has_subdomains}
        facts = json.dumps(sizes | {"multigrid": cost}, indent=1)
        on_root(self.comm, lambda: write_whole(folder / "system.json", facts + "\n"))
        for owned in (rigid, matrix, right, coordinates, correction, y, rough):
            owned.destroy()
        log.info("step %d: its first linear system is in %s", step, folder)

    def sum_up(self) -> None:
        """Warn of chosen steps without a system."""
        if self.steps:
            numbers = ", ".join(map(str, sorted(self.steps)))
            log.warning("no linear system was solved in step %s, so none is exported", numbers)


def _refuse_terms(scene: Scene) -> None:
    """Raise InputError for pins of single components and for pressures."""
    partial = [held.key for held in held_by(scene) if not all(held.table.held)]
    for key in [*partial, *(table.key for table in scene.tables("pressure"))]:
        raise InputError(
            f"--export: {key} has no place in the exported matrix, which has whole nodes and no "
            "pressure: leave it out, or hold all components"
        )


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


def _solved(now: Iterate, jacobian: Jacobian, rtol: float, y: PETSc.Vec) -> dict[str, Any]:
    """Solve H y = F by CG with our multigrid, and return the cost (collective).

    rtol : |F - H y| over |F| at the end

    The work does not count as the step's.
    """
    given, began = jacobian.preconditioner, perf_counter()
    multigrid = StepPreconditioner(
        given.make_of_matrix, given.make_multigrid, MULTIGRID, False, 0.0
    )
    multigrid.prepare(now.q, now.contact)
    ready = perf_counter()
    ksp = PETSc.KSP().create(jacobian.comm)
    operator = python_matrix(jacobian.unknowns, copy(jacobian.hessian), jacobian.comm)
    ksp.setOperators(operator)
    ksp.setType(PETSc.KSP.Type.CG)
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.getPC().setType(PETSc.PC.Type.PYTHON)
    ksp.getPC().setPythonContext(multigrid)
    ksp.setTolerances(rtol=rtol)
    ksp.solve(now.f, y)
    cost = {
        "iterations": ksp.its,
        "set_up": ready - began,
        "seconds": perf_counter() - ready,
        "status": "ok" if ksp.reason > 0 else "failed",
    }
    ksp.destroy()
    operator.destroy()
    return cost
