"""A run, once PETSc has its options: prepared, its output opened, its steps taken and observed, its files finished."""

import json
import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from signal import Signals as Signal
from time import perf_counter

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from tqdm import tqdm

from msmpetsc import __version__
from msmpetsc.backend.compiling import compilation_logged
from msmpetsc.cli.arguments import option_names
from msmpetsc.cli.failure import ending_together
from msmpetsc.cli.running.observers import (
    STATUS,
    Callback,
    Checkpoints,
    FrameWriter,
    Interval,
    Observer,
    PageWriter,
    ProgressLine,
    Signals,
)
from msmpetsc.cli.running.profile import Cost, refuse_unwritable, versions
from msmpetsc.cli.running.request import RunRequest
from msmpetsc.cli.running.resume import Resumed, stored_scene
from msmpetsc.comm import log, on_root
from msmpetsc.errors import InputError, StepFailed
from msmpetsc.model.build import Model, build_model
from msmpetsc.model.material import STEPS_A_PERIOD, bending_period
from msmpetsc.model.reach import Reach
from msmpetsc.output.model import write_model
from msmpetsc.output.progress import duration
from msmpetsc.output.restart import Earlier
from msmpetsc.output.writer import Begin, ResultFile
from msmpetsc.output.xdmf import write_xdmf
from msmpetsc.scene.reading import load_scene, scene_in
from msmpetsc.scene.schema import Scene
from msmpetsc.scene.toml import toml_of
from msmpetsc.solve.instrumentation import Probes, begin_timing
from msmpetsc.solve.options import refuse_early
from msmpetsc.solve.petsc.device import choose
from msmpetsc.solve.petsc.events import SETUP, begun
from msmpetsc.solve.presets import preset_names
from msmpetsc.solve.simulate import Simulation, refuse_bad_options

MOST_NAMED = 12  # tables whose nodes are counted one by one


@dataclass(frozen=True)
class RunPlan:
    """What a run does, once its request is understood.

    began           : count of perf_counter when that began [s]
    attributes      : what the file says of the run that made it
    kernels_are_new : whether numba's cache was empty
    """

    request: RunRequest
    scene: Scene
    probes: Probes
    interval: Interval
    resumed: Resumed | None
    attributes: dict[str, str | int]
    began: float
    kernels_are_new: bool

    @property
    def is_done(self) -> bool:
        """Whether the file has all frames already."""
        return self.resumed is not None and self.resumed.is_done


@dataclass(frozen=True)
class Outcome:
    """How a march ended: at its last step, by a signal, or by a step that failed."""

    simulation: Simulation
    file: ResultFile
    cost: Cost
    signal: int
    failure: StepFailed | None

    @property
    def is_whole(self) -> bool:
        """Whether all steps were taken."""
        return not self.signal and self.failure is None


def prepare(comm: MPI.Intracomm, request: RunRequest, earlier: Earlier | None, kernels_are_new: bool) -> RunPlan:
    """Read the scene, and raise InputError for what can be refused before there is a model (collective)."""
    refuse_early(comm, option_names("run"))
    choose(comm, request.device)
    began = perf_counter()
    if request.measure:
        begin_timing()
    probes, interval = Probes(request.true_error, request.trace), Interval.parsed(request.checkpoint_every)
    scene = comm.bcast(on_root(comm, lambda: read_scene(request, earlier)))
    refuse_bad_options(comm, scene, probes)
    refuse_steps_beyond(scene.time.steps, request, earlier.step if earlier else 0)
    on_root(comm, lambda: refuse_unwritable(request.measure))
    attributes = attributes_of(comm, scene, request)
    resumed = Resumed(earlier, scene, PETSc.Options().getAll(), request.force) if earlier else None
    return RunPlan(request, scene, probes, interval, resumed, attributes, began, kernels_are_new)


def march(comm: MPI.Intracomm, plan: RunPlan) -> Outcome:
    """Build the model and take its steps; after each, call the observers (collective)."""
    failure = None
    with (
        compilation_logged(plan.kernels_are_new),
        Signals(comm) as signals,
        begun(SETUP) as set_up,
        open_output(comm, plan) as file,
        Simulation(comm, plan.scene, model := described_model(comm, plan), plan.probes) as simulation,
    ):
        try:
            with ending_together(comm):
                simulation.refuse_unused_options()
                cost = Cost(comm, simulation, perf_counter() - plan.began)
                frames = start_output(comm, plan, file, model, simulation)
                checkpoints = Checkpoints(file, simulation, plan.interval, signals)
                set_up.close()
                with ProgressLine.shown(comm, simulation.steps) as progress, live_page(comm, plan, file, model) as page:
                    observers: list[Observer] = [FrameWriter(file, frames), *page, progress, checkpoints, cost]
                    observers += [Callback(plan.request.on_frame)] if plan.request.on_frame else []
                    signals.begin()
                    for frame in simulation.advance():
                        with cost.of_output():
                            stops = [observer.after_step(frame) for observer in observers]
                        if any(stops):
                            break
        except StepFailed as error:
            failure = error  # the frames before it are worth a look
        file.close(trim=not checkpoints.signal)
    return Outcome(simulation, file, cost, checkpoints.signal, failure)


def finish(comm: MPI.Intracomm, plan: RunPlan, outcome: Outcome, started: float) -> int:
    """Write what stands beside the result and say how the run ended; return the exit status (collective).

    started : count of perf_counter at the start of the command [s]

    Raises the StepFailed that ended the run.
    """
    request, simulation = plan.request, outcome.simulation
    if request.measure:
        outcome.cost.write(request.measure, request.command, outcome.failure)
    on_root(comm, lambda: write_companions(request, outcome.is_whole))
    left = files_of(request, outcome.is_whole)
    on_root(comm, lambda: log_end(outcome.file.finished, perf_counter() - started, outcome.cost.setup, left))
    if outcome.failure:
        raise outcome.failure
    if outcome.signal:
        return tell_stop(outcome.signal, request.path, simulation)
    simulation.refuse_unused_options(at_end=True)
    return 0


def tell_done(comm: MPI.Intracomm, plan: RunPlan) -> int:
    """Finish the files of a run that has all its frames; return the exit status (collective)."""
    on_root(comm, lambda: write_companions(plan.request, whole=True))
    earlier = plan.resumed.earlier if plan.resumed else None
    if earlier and earlier.finished < plan.scene.stored:
        log.info("%s came to rest after step %d: nothing left to do", plan.request.path, earlier.step)
    else:
        log.info("%s has all its %d frames: nothing left to do", plan.request.path, plan.scene.stored)
    return 0


# Before the steps


def read_scene(request: RunRequest, earlier: Earlier | None) -> Scene:
    """Read the scene with what the request changes; --set comes last and wins."""

    def changed(changes: list[str]) -> Scene:
        if request.made is not None:
            return scene_in(request.made.folder, toml_of(request.made.text), changes)
        if request.scene is not None:
            return load_scene(request.scene, changes, preset_names())
        assert earlier is not None  # as earlier_run sees to
        return stored_scene(earlier, changes, preset_names())

    changes = [] if request.preset is None else [f"solver.preset={json.dumps(request.preset)}"]
    changes += [] if request.error is None else [f"solver.error={request.error}"]
    changes += request.set
    scene = changed(changes)
    if request.frames is None:
        return scene
    return changed([*changes, f"time.duration={request.frames * scene.time.step!r}"])


def refuse_steps_beyond(steps: int, request: RunRequest, taken: int) -> None:
    """Raise InputError for steps to be measured that the run does not come to, or that it took before."""
    if request.trace is not None and request.trace <= taken:
        raise InputError(f"--trace {request.trace}: the run goes on after step {taken}")
    for option, number in {"--true-error": request.true_error, "--trace": request.trace}.items():
        if number is not None and number > steps:
            raise InputError(f"{option} {number}: the run has {steps} step{'s' * (steps > 1)} only")


def attributes_of(comm: MPI.Intracomm, scene: Scene, request: RunRequest) -> dict[str, str | int]:
    """Return what the file says of the run that made it; PETSc's options are the user's, before ours are among them."""
    options = PETSc.Options().getAll().items()
    file = request.made.folder / "scene" if request.made else request.scene  # where its paths start
    return {
        "msmpetsc_version": __version__,
        "petsc_version": versions()["petsc"],
        "petsc_options": " ".join(f"-{name} {shlex.quote(value)}" if value else f"-{name}" for name, value in options),
        "ranks": comm.size,
        "command": request.command,
        "scene": scene.text,
        "scene_file": str(file.resolve()) if file else "",
        "true_error": request.true_error or 0,
    }


def open_output(comm: MPI.Intracomm, plan: RunPlan) -> ResultFile:
    """Open the file to write into: a new one, or that of the run that goes on (collective)."""
    request = plan.request
    if plan.resumed:
        return plan.resumed.file(comm, plan.attributes)
    begin = Begin.OVERWRITE if request.overwrite else Begin.NEW
    return ResultFile(request.path, comm, plan.attributes, begin)


@contextmanager
def live_page(comm: MPI.Intracomm, plan: RunPlan, file: ResultFile, model: Model) -> Iterator[list[Observer]]:
    """Yield the observer that keeps a page of the run, on rank 0 and where it is asked for."""
    path = plan.request.watch
    if path is None or comm.rank > 0:
        yield []
        return
    from msmpetsc.output.drawing.live import LivePage

    page = LivePage(path, plan.scene, model.surface, file.newest_surface, model.body_of_point, model.solids)
    try:
        yield [PageWriter(page)]
    finally:
        page.end()


def described_model(comm: MPI.Intracomm, plan: RunPlan) -> Model:
    """Build the model and say what it is made of (collective)."""
    model = build_model(comm, plan.scene)
    log_model(comm, model)
    warn_of_long_steps(plan.scene, model)
    if plan.resumed:
        plan.resumed.refuse_other_lattice(comm, model)
    return model


def start_output(comm: MPI.Intracomm, plan: RunPlan, file: ResultFile, model: Model, simulation: Simulation) -> int:
    """Write the model, go on where an earlier run stopped, and make room for frames (collective).

    model : as it was built; the simulation's own may be on a GPU

    Returns the number of frames of the steps taken so far.
    """
    write_model(comm, file, model)
    if plan.resumed:
        plan.resumed.restore(comm, file, simulation)
    lattice, embedding = model.lattice, model.embedding
    points = embedding.points if embedding else None
    file.start_frames(simulation.stored, lattice.owned, points, saved=simulation.saved())
    return simulation.stored_until(simulation.step) if simulation.step else 0


# After the steps


def write_companions(request: RunRequest, whole: bool) -> None:
    """Write the XDMF file, and for a whole run pack the result and draw it where asked. Raises InputError."""
    path = request.path
    if whole and request.compress:
        from msmpetsc.output.compress import pack

        pack(path)
    write_xdmf(path)
    if whole and request.picture:
        from msmpetsc.output.drawing.sheet import contact_sheet  # loads VTK: a second that other runs need not wait

        contact_sheet(path, path.with_suffix(".png"))


def files_of(request: RunRequest, whole: bool) -> list[Path]:
    """List the files that a run leaves, the result first; a picture is drawn of a whole one."""
    path = request.path
    picture = [path.with_suffix(".png")] if request.picture and whole else []
    return [path, path.with_suffix(".xdmf"), *picture, *([request.measure] if request.measure else [])]


def tell_stop(number: int, path: Path, simulation: Simulation) -> int:
    """Say in one line how to go on after a signal; return the exit status of that signal."""
    log.warning(
        "stopped by %s after step %d of %d (t = %.6g s); to go on: msmpetsc run --resume %s",
        Signal(number).name, simulation.step, simulation.steps, simulation.step * simulation.time_step,
        shlex.quote(str(path)),
    )  # fmt: skip
    return STATUS[number]


# What a run says of itself


def log_model(comm: MPI.Intracomm, model: Model) -> None:
    """Log size, volume and mass of bodies and lattice, counts, and nodes that the scene's tables take (collective)."""
    lattice = model.lattice
    log_bodies(comm, model)
    held = int(lattice.pinned[: lattice.owned].sum())
    cells, springs, pinned = (comm.allreduce(number) for number in (len(lattice.cells), lattice.springs_owned, held))
    log.info(
        "%d cells of %.4g m, %d nodes (%d pinned), %d springs on %d rank%s",
        cells, lattice.cell_size, lattice.table.total, pinned, springs, comm.size, "s" * (comm.size > 1),
    )  # fmt: skip
    if named := taken(model.reaches):
        log.info("%s", ", ".join(named))


def warn_of_long_steps(scene: Scene, model: Model) -> None:
    """Warn of steps that are longer than the slowest motion of any body, which implicit steps damp away.

    That is taken to be the bending of a bar of the body's longest and shortest side: of most bodies it is not so slow.
    """
    time = scene.time
    if time.integrator not in ("implicit-euler", "bdf2") or time.error is not None:
        return
    moduli = [body.material and body.material.young_modulus for body in scene.body] or [None]
    softest = min((modulus or scene.material.young_modulus or np.inf) for modulus in moduli)
    lengths = [body.bounds[1] - body.bounds[0] for body in model.bodies]
    period = max(bending_period(sides.max(), sides.min(), softest, scene.material.density) for sides in lengths)
    if time.step > period > 0:
        log.warning(
            "time.step is %.2g periods of the slowest vibration, about %.1g s, which it damps away: time.step = %.1g "
            'shows it, time.integrator = "static" goes to rest at once',
            time.step / period, period, period / STEPS_A_PERIOD,
        )  # fmt: skip


def log_bodies(comm: MPI.Comm, model: Model) -> None:
    """Log size, volume and mass of each body and its part of the lattice (collective)."""
    lattice, bodies = model.lattice, model.bodies
    masses = np.bincount(lattice.body[: lattice.owned], lattice.mass, len(bodies))
    shares = np.bincount(lattice.body_of(lattice.cells[:, 0]), lattice.cell_share, len(bodies))
    sums = comm.allreduce(np.array([masses, shares * lattice.cell_size**3]))
    for number, (body, (mass, volume)) in enumerate(zip(bodies, sums.T, strict=True)):
        mesh = f"open mesh ({body.report.boundary_edges} boundary edges), its volume unknown"
        if body.report.closed:
            enclosed = abs(body.report.volume)
            mesh = f"closed mesh of {enclosed:.4g} m^3, {mass / volume * enclosed:.4g} kg"
        name = f"body.{number}" if len(bodies) > 1 else "body"
        size = sides(body.bounds[1] - body.bounds[0])
        log.info("%s of %s m; %s; lattice of %.4g m^3, %.4g kg", name, size, mesh, volume, mass)


def sides(lengths: Iterable[float]) -> str:
    """Return "0.3 x 0.2325 x 0.2974" of three lengths."""
    return " x ".join(f"{length:.4g}" for length in lengths)


def taken(reaches: Iterable[Reach]) -> list[str]:
    """Name what each anchor and force takes; of a force's nodes some may be held, which take their part of it, too."""
    named = []
    for reach in reaches:
        if reach.kind == "anchor":
            named.append(f"{reach.key} leads {reach.nodes - reach.held} nodes")
        elif reach.kind == "force":
            held = f" ({reach.held} of them held)" if reach.held else ""
            named.append(f"{reach.key} pulls {reach.nodes} nodes{held}")
    more = len(named) - MOST_NAMED
    return named if more <= 1 else [*named[:MOST_NAMED], f"and {more} more"]


def log_end(frames: int, seconds: float, setup: float, files: Iterable[Path]) -> None:
    """Log how long it took [s], and which files there are; the first of them holds the frames."""
    sizes = {path: tqdm.format_sizeof(path.stat().st_size, "B") for path in files if path.is_file()}
    result, *others = (f"{path} ({size})" for path, size in sizes.items())
    log.info("took %s, %s of it before the first step", spoken(seconds), spoken(setup))
    log.info("left %d frame%s in %s", frames, "s" * (frames != 1), ", ".join([result, *others]))


def spoken(seconds: float) -> str:
    """Return a time as a person would say it; short ones with a digit more."""
    return f"{seconds:.1f} s" if seconds < 10 else duration(seconds)
