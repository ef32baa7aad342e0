"""The start of a run: PETSc gets its options, and only then what needs them is imported."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from msmpetsc.app.ending import STATUS_INTERRUPTED, ending_together, logged_on_root
from msmpetsc.app.request import RunRequest, asked_by

if TYPE_CHECKING:
    from mpi4py import MPI

    from msmpetsc.results.restart import Earlier


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
    started = perf_counter()
    with options_given(comm, request) as (asked, earlier):
        from msmpetsc.app.running import finish, prepare, take_steps, tell_done  # PETSc, which has its options now

        plan = prepare(comm, asked, earlier)
        if plan.resumed and plan.resumed.is_done:
            return tell_done(comm, asked, plan.resumed)
        return finish(comm, plan, take_steps(comm, plan), started)


def options_shown(comm: "MPI.Intracomm", request: RunRequest) -> list[str]:
    """Return a run's options of PETSc as lines of a file; no mesh is read (collective)."""
    with options_given(comm, request) as (asked, earlier):
        from msmpetsc.app.running import lines_of_options

        return lines_of_options(comm, asked, earlier)


@contextmanager
def options_given(comm: "MPI.Intracomm", request: RunRequest) -> Iterator[tuple[RunRequest, "Earlier | None"]]:
    """Give PETSc the options of a request, and of the run that it goes on from (collective)."""
    import numpy as np

    from msmpetsc.app.resume import as_before, earlier_run
    from msmpetsc.solve.petsc.initialise import lent_options

    earlier = earlier_run(comm, request)
    asked = as_before(request, earlier)
    with lent_options(comm, asked.petsc_words), np.errstate(all="ignore"):  # a step tells of what overflows
        yield asked, earlier
