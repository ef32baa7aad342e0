"""A run after PETSc has its options: preparation, steps, output, and the end."""

import logging
import shlex
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from time import perf_counter
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc import __version__
from msmpetsc.app.abort import ending_together
from msmpetsc.app.checkpoint_writer import Checkpoints
from msmpetsc.app.exported_systems import ExportedSystems
from msmpetsc.app.request import RunRequest
from msmpetsc.app.resume import Resumed, stored_scene
from msmpetsc.app.signals import Signals
from msmpetsc.app.summary import (
    Cost,
    log_end,
    log_model,
    refuse_unwritable,
    tell_stop,
    versions,
    warn_of_long_steps,
)
from msmpetsc.backend import kernel_cache
from msmpetsc.build import Model, build_model
from msmpetsc.comm import log, on_root
from msmpetsc.errors import InputError, StepFailed
from msmpetsc.fields import Frame
from msmpetsc.results.checkpoint_reader import Earlier, end_of_run
from msmpetsc.results.progress_bar import Progress
from msmpetsc.results.writer import Begin, ResultFile, write_model
from msmpetsc.results.xdmf import write_xdmf
from msmpetsc.scene.reading import Scene, load_scene
from msmpetsc.scene.schema import Solver
from msmpetsc.solve.instrumentation import event_times
from msmpetsc.solve.petsc.device import choose
from msmpetsc.solve.petsc.events import SETUP, begun
from msmpetsc.solve.presets import find_preset, shown_options
from msmpetsc.solve.refused_options import refuse_early, silence_options_left
from msmpetsc.solve.simulate import TimeLoop, refuse_bad_options, solvers_of


@dataclass(frozen=True)
class RunPlan:
    """The scene of a run, the earlier run that it continues, and the time of its beginning.

    began  : perf_counter at the beginning of preparation [s]
    logged : time in each logged event of the process before that [s]; empty without ``measure``
    """

    request: RunRequest
    scene: Scene
    resumed: Resumed | None
    began: float
    logged: dict[str, float]


def run_steps(comm: MPI.Intracomm, request: RunRequest, earlier: Earlier | None) -> int:
    """Run from the start or continue an earlier run; return the exit status (collective)."""
    plan = prepare(comm, request, earlier)
    if (resumed := plan.resumed) and resumed.is_done:
        write_companions(comm, request, whole=True)
        log.info(
            "%s has all its %d frames: nothing left to do", request.path, resumed.earlier.finished
        )
        return 0
    return finish(comm, plan, *take_steps(comm, plan))


def prepare(comm: MPI.Intracomm, request: RunRequest, earlier: Earlier | None) -> RunPlan:
    """Read the scene and check it, without building a model (collective). Raises InputError."""
    refuse_early(comm)
    choose(comm, request.device)
    began = perf_counter()
    logged: dict[str, float] = {}
    if request.measure:
        PETSc.Log.begin()
        logged = event_times()
    scene = comm.bcast(on_root(comm, lambda: read_scene(request, earlier)))
    refuse_bad_options(scene, request.true_error, request.exported)
    on_root(comm, lambda: refuse_unwritable(request.measured))
    resumed = Resumed(earlier, scene, PETSc.Options().getAll(), request.force) if earlier else None
    return RunPlan(request, scene, resumed, began, logged)


def take_steps(comm: MPI.Intracomm, plan: RunPlan) -> tuple[Checkpoints, Cost, StepFailed | None]:
    """Take the steps and write their frames and checkpoints (collective).

    Returns the checkpoints, which have the signal that stopped the run, the cost, and the failed
    step that ended the run, or None.
    """
    failure, request = None, plan.request
    systems = None
    if request.export:
        systems = ExportedSystems(comm, Path(request.export), request.exported)
    if kernel_cache.is_empty():
        once = "once" if kernel_cache.writable() else "as no folder can keep them (NUMBA_CACHE_DIR)"
        log.info("compiling kernels, %s, about a minute", once)
    with (
        Signals(comm) as signals,
        begun(SETUP) as set_up,
        open_output(comm, plan) as file,
        TimeLoop(
            comm, plan.scene, model := described_model(comm, plan), plan.request.true_error, systems
        ) as simulation,
    ):
        try:
            with ending_together(comm, abandon=file.abandon):
                simulation.refuse_unused_options()
                cost = Cost(comm, simulation, perf_counter() - plan.began)
                numbers = count(start_output(comm, plan, file, model, simulation))
                checkpoints = Checkpoints(comm, file, simulation, plan.request.checkpoint_every)
                is_shown = comm.rank == 0 and log.isEnabledFor(logging.INFO)
                set_up.close()
                with closing(Progress(simulation.steps, is_shown)) as progress:
                    observers: list[Callable[[Frame], object]] = [cost.count, progress.update]
                    if on_frame := plan.request.on_frame:
                        observers.append(lambda frame: on_frame(frame.with_own_positions()))
                    signals.begin(file.abandon)
                    for frame in checkpoints.steps():
                        with cost.of_output():
                            # a resumed file has frames up to its checkpoint already
                            if frame is not None and next(numbers) >= file.finished:
                                file.append(frame)
                            stops = checkpoints.after_step(frame is not None)
                            if frame is not None:
                                for observe in observers:
                                    observe(frame)
                        if stops:
                            break
        # the frames before the failure are kept
        except StepFailed as error:
            failure = error
        if systems and not checkpoints.signal:
            systems.sum_up()
        file.close()
    return checkpoints, cost, failure


def finish(
    comm: MPI.Intracomm, plan: RunPlan, ended: Checkpoints, cost: Cost, failure: StepFailed | None
) -> int:
    """Write the files beside the result, log the end, and return the exit status (collective).

    Raises the StepFailed that ended the run.
    """
    request = plan.request
    if request.measured:
        cost.write(request.measured, request.command, plan.logged, failure)
    left = write_companions(comm, request, whole=not ended.signal and failure is None)
    seconds = perf_counter() - plan.began
    on_root(comm, lambda: log_end(ended.file.finished, seconds, cost.setup, left))
    if failure:
        raise failure
    if ended.signal:
        return tell_stop(ended.signal, request.path, ended.simulation)
    ended.simulation.refuse_unused_options(at_end=True)
    return 0


def lines_of_options(
    comm: MPI.Intracomm, request: RunRequest, earlier: Earlier | None
) -> list[str]:
    """Return the PETSc options of a run, or of a preset if no scene is given, as lines.

    Collective.
    """
    refuse_early(comm)
    choose(comm, request.device)
    if request.scene or earlier:
        scene = comm.bcast(on_root(comm, lambda: read_scene(request, earlier)))
        solvers = solvers_of(scene, request.true_error)
    elif request.set or request.frames:
        raise InputError(
            "--set and --frames change a scene: name the SCENE; --preset alone needs none"
        )
    else:
        solvers = {"": (find_preset(request.preset or Solver.model_fields["preset"].default), 0)}
    lines = shown_options(solvers)
    silence_options_left()
    return lines


def read_scene(request: RunRequest, earlier: Earlier | None) -> Scene:
    """Return the scene with the changes of the request, ``--set`` last. Raises InputError."""
    changes = request.overrides
    if isinstance(request.scene, Scene):
        scene = request.scene.changed(changes)
    elif isinstance(request.scene, Mapping):
        scene = Scene.of(request.scene, changes=changes)
    elif request.file is not None:
        scene = load_scene(request.file, changes)
    elif earlier is not None:
        scene = stored_scene(earlier, changes)
    else:
        raise InputError("a SCENE is needed, or --resume OUT.h5")
    return scene.changed(
        {"time.duration": request.frames * scene.time.step} if request.frames else {}
    )


def attributes_of(comm: MPI.Intracomm, scene: Scene, request: RunRequest) -> dict[str, Any]:
    """Return the attributes of the result file: versions, options, ranks, command and scene."""
    options = PETSc.Options().getAll().items()
    # a scene without a file has its paths relative to its folder
    file = request.file or scene.folder / "scene"
    return {
        "msmpetsc_version": __version__,
        "petsc_version": versions()["petsc"],
        "petsc_options": " ".join(
            f"-{name} {shlex.quote(value)}" if value else f"-{name}" for name, value in options
        ),
        "ranks": comm.size,
        "command": request.command,
        "scene": scene.text,
        "scene_file": str(file.resolve()) if request.scene is not None else "",
        "true_error": request.true_error or 0,
    }


def open_output(
    comm: MPI.Intracomm, plan: RunPlan, more: Mapping[str, Any] | None = None
) -> ResultFile:
    """Open a new result file, or the file of the resumed run, for writing (collective).

    more : further attributes of the file
    """
    request = plan.request
    attributes = attributes_of(comm, plan.scene, request) | dict(more or {})
    if plan.resumed:
        return plan.resumed.file(comm, attributes)
    begin = Begin.OVERWRITE if request.overwrite else Begin.NEW
    return ResultFile(request.path, comm, attributes, begin)


def described_model(comm: MPI.Intracomm, plan: RunPlan) -> Model:
    """Build the model, log its size, and check it against a resumed run's lattice (collective)."""
    model = build_model(comm, plan.scene, None, partial(end_of_run, comm, plan.scene.folder))
    log_model(comm, model)
    warn_of_long_steps(plan.scene, model)
    if plan.resumed:
        plan.resumed.refuse_other_lattice(comm, model)
    return model


def start_output(
    comm: MPI.Intracomm, plan: RunPlan, file: ResultFile, model: Model, simulation: TimeLoop
) -> int:
    """Write the model, restore a resumed run, and create the frame datasets (collective).

    model : in CPU memory, unlike the simulation's model, which may be on a GPU

    Returns the number of frames up to the restored step.
    """
    write_model(comm, file, model)
    kept = plan.resumed.restore(comm, simulation) if plan.resumed else None
    rows, saved = simulation.rows, simulation.saved
    file.start_frames(simulation.stored, model.lattice.owned, rows, saved, kept)
    return simulation.stored_until(simulation.step) if simulation.step else 0


def write_companions(comm: MPI.Intracomm, request: RunRequest, whole: bool) -> list[Path]:
    """Write the XDMF file and a picture if requested; return all files of the run (collective).

    whole : whether the run is complete; otherwise no picture is drawn

    Raises InputError.
    """
    path = request.path
    left = [path, path.with_suffix(".xdmf")]
    on_root(comm, lambda: write_xdmf(path))
    if whole and request.picture:
        # imported here, as loading VTK takes a second
        from msmpetsc.view.sheet import contact_sheet

        left.append(path.with_suffix(".png"))
        on_root(comm, lambda: contact_sheet(path, left[-1]))
    return [*left, *filter(None, [request.measured])]
