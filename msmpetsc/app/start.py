"""The start of a run: PETSc gets its options, and only then what needs them is imported."""

import logging
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from msmpetsc.app.failure import STATUS_INTERRUPTED, ending_together
from msmpetsc.app.log import logged_on_root
from msmpetsc.app.request import FLAGS, RunRequest, asked_by
from msmpetsc.comm import on_root
from msmpetsc.errors import InputError

if TYPE_CHECKING:
    from mpi4py import MPI


@asked_by(RunRequest)
def run(ask: Callable[[], RunRequest]) -> Path:
    """Run a scene as ``msmpetsc run`` does, and return the path of its result (collective).

        path = msmpetsc.run("scene.toml", "out/scene.h5", frames=10, set={"material.density": 900.0})

    Raises InputError and StepFailed on all ranks. Stopped by a signal, the run leaves a file that resume="OUT.h5"
    takes up, and raises what Python raises there: KeyboardInterrupt for SIGINT, SystemExit for SIGTERM.
    """
    from mpi4py import MPI

    from msmpetsc.solve.petsc.initialise import start_for_runs

    comm = MPI.COMM_WORLD
    with ending_together(comm):
        request = ask()
        with logged_on_root(comm, logging.WARNING if request.quiet else logging.INFO):
            start_for_runs(comm, request.petsc_words)
            status = carry_out(comm, request)
    if status:
        raise KeyboardInterrupt if status == STATUS_INTERRUPTED else SystemExit(status)
    return request.path


def carry_out(comm: "MPI.Intracomm", request: RunRequest) -> int:
    """Carry out a run; return its exit status (collective)."""
    import numpy as np

    from msmpetsc.app.resume import as_before, earlier_run
    from msmpetsc.backend.compiling import cache_is_empty
    from msmpetsc.solve.petsc.initialise import lent_options

    started = perf_counter()
    earlier = earlier_run(comm, request)
    request = as_before(request, earlier)
    with lent_options(comm, request.petsc_words), np.errstate(all="ignore"):  # a step tells of what overflows
        kernels_are_new = cache_is_empty()
        from msmpetsc.app.run import finish, prepare, take_steps, tell_done  # PETSc, which has its options now

        plan = prepare(comm, request, earlier, kernels_are_new)
        if plan.is_done:
            return tell_done(comm, plan)
        return finish(comm, plan, take_steps(comm, plan), started)


def options_shown(comm: "MPI.Intracomm", request: RunRequest) -> list[str]:
    """Return what a run would have in PETSc's options database as lines of a file; no mesh is read (collective)."""
    from msmpetsc.app.resume import as_before, earlier_run
    from msmpetsc.scene.schema import Solver
    from msmpetsc.solve.petsc.initialise import lent_options

    earlier = earlier_run(comm, request) if request.scene or request.resume else None
    request = as_before(request, earlier)
    with lent_options(comm, request.petsc_words):
        from msmpetsc.app.run import read_scene
        from msmpetsc.solve.instrumentation import Probes
        from msmpetsc.solve.petsc.device import choose
        from msmpetsc.solve.presets import find_preset, shown_options
        from msmpetsc.solve.refused_options import refuse_bad_values, refuse_early, silence_options_left
        from msmpetsc.solve.simulate import solvers_of

        refuse_early(comm, FLAGS)
        choose(comm, request.device)
        if request.scene or earlier:
            scene = comm.bcast(on_root(comm, lambda: read_scene(request, earlier)))
            solvers = solvers_of(scene, Probes(request.true_error, request.trace))
        elif request.set or request.frames:
            raise InputError("--set and --frames change a scene: name the SCENE; --preset alone needs none")
        else:
            solvers = {"": (find_preset(request.preset or Solver.model_fields["preset"].default), 0)}
        on_root(comm, lambda: refuse_bad_values(solvers))
        lines = shown_options(solvers)
        silence_options_left()
    return lines
