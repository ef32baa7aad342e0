"""``msmpetsc run``: simulate a scene and write its result file."""

import argparse
from time import perf_counter

import numpy as np
from mpi4py import MPI

from msmpetsc.cli.arguments import option_names
from msmpetsc.cli.running.request import RunRequest, earlier_run
from msmpetsc.comm import on_root
from msmpetsc.errors import InputError
from msmpetsc.scene.schema import Solver
from msmpetsc.solve.petsc.words import lent_options


def run(args: argparse.Namespace) -> int:
    """Simulate a scene; return the exit status (collective)."""
    comm, started = MPI.COMM_WORLD, perf_counter()
    request = RunRequest.from_args(args)
    if args.show_options:
        return show_options(comm, request)
    earlier = earlier_run(comm, request)
    request = request.going_on_from(earlier)
    with lent_options(comm, request.petsc_options), np.errstate(all="ignore"):  # a step tells of what overflows
        from msmpetsc.backend.compiling import cache_is_empty

        kernels_are_new = cache_is_empty()
        from msmpetsc.cli.running.march import finish, march, prepare, tell_done  # PETSc, which has its options now

        plan = prepare(comm, request, earlier, kernels_are_new)
        if plan.is_done:
            return tell_done(comm, plan)
        return finish(comm, plan, march(comm, plan), started)


def show_options(comm: MPI.Comm, request: RunRequest) -> int:
    """Print what a run would have in PETSc's options database, which takes no mesh (collective)."""
    earlier = earlier_run(comm, request) if request.scene or request.resume else None
    request = request.going_on_from(earlier)
    with lent_options(comm, request.petsc_options):
        from msmpetsc.cli.running.march import read_scene
        from msmpetsc.solve.instrumentation import Probes
        from msmpetsc.solve.options import refuse_bad_values, refuse_early, silence_options_left
        from msmpetsc.solve.petsc.device import choose
        from msmpetsc.solve.presets import find_preset, shown_options
        from msmpetsc.solve.simulate import solvers_of

        refuse_early(comm, option_names("run"))
        choose(comm, request.device)
        if request.scene or earlier:
            scene = comm.bcast(on_root(comm, lambda: read_scene(request, earlier)))
            solvers = solvers_of(scene, Probes(request.true_error, request.trace))
        elif request.set or request.frames:
            raise InputError("--set and --frames change a scene: name the SCENE; --preset alone needs none")
        else:
            solvers = {"": (find_preset(request.preset or Solver.model_fields["preset"].default), 0)}
        on_root(comm, lambda: refuse_bad_values(solvers))
        if comm.rank == 0:
            print("\n".join(shown_options(solvers)))
        silence_options_left()
    return 0
