"""The start of runs: PETSc gets its options, and only then what needs it is imported."""

import inspect
import logging
import shlex
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from os import PathLike
from pathlib import Path
from time import perf_counter
from typing import Any, ParamSpec, TypeVar

import numpy as np
from mpi4py import MPI

from msmpetsc.app.ending import STATUS_INTERRUPTED, ending_together, logged_on_root
from msmpetsc.app.request import OPTIONS, RunRequest
from msmpetsc.app.resume import earlier_run, kept_options
from msmpetsc.build import Geometry, Model, build_model
from msmpetsc.errors import InputError
from msmpetsc.fields import Frame
from msmpetsc.results.restart import Earlier
from msmpetsc.scene.reading import Scene
from msmpetsc.solve.petsc.initialise import lent_options, start_for_runs
from msmpetsc.solve.petsc.words import words_of

P = ParamSpec("P")
T = TypeVar("T")
Source = str | PathLike[str] | Mapping[str, Any] | Scene  # a scene file, its tables, or a scene


def asked_by(request: Callable[P, object]) -> Callable[[Callable[..., T]], Callable[P, T]]:
    """Return a decorator that gives a function the arguments of a request, and their help."""

    def decorate(function: Callable[..., T]) -> Callable[P, T]:
        signature = inspect.signature(request).replace(
            return_annotation=function.__annotations__["return"]
        )
        function.__signature__ = signature  # type: ignore[attr-defined]  # which help() shows
        lines = (f"    {name:16} : {option.help}" for name, option in OPTIONS.items())
        function.__doc__ = "\n".join([function.__doc__ or "", *lines, ""])
        return function

    return decorate


@asked_by(RunRequest)
def run(*values: Any, **keywords: Any) -> Path:
    """Run a scene as ``msmpetsc run`` does, and return the path of its result (collective).

        path = msmpetsc.run("scene.toml", "out/x.h5", frames=10, set={"material.density": 900.0})

    Raises InputError and StepFailed on all ranks. Stopped by a signal, the run leaves a file that resume="OUT.h5"
    takes up, and raises what Python raises there: KeyboardInterrupt for SIGINT, SystemExit for SIGTERM.
    """
    comm = MPI.COMM_WORLD
    with ending_together(comm):
        request = RunRequest(*values, **keywords)
        with logged_on_root(comm, logging.WARNING if request.quiet else logging.INFO):
            start_for_runs(comm, request.petsc_words)
            status = carry_out(comm, request)
    if status:
        raise KeyboardInterrupt if status == STATUS_INTERRUPTED else SystemExit(status)
    return request.path


def carry_out(comm: MPI.Intracomm, request: RunRequest) -> int:
    """Carry out a run; return its exit status (collective)."""
    started = perf_counter()
    with options_given(comm, request) as (asked, earlier):
        from msmpetsc.app.running import run_steps  # PETSc, which has its options now

        return run_steps(comm, asked, earlier, started)


def options_shown(comm: MPI.Intracomm, request: RunRequest) -> list[str]:
    """Return a run's options of PETSc as lines of a file; no mesh is read (collective)."""
    with options_given(comm, request) as (asked, earlier):
        from msmpetsc.app.running import lines_of_options

        return lines_of_options(comm, asked, earlier)


@contextmanager
def options_given(
    comm: MPI.Intracomm, request: RunRequest
) -> Iterator[tuple[RunRequest, Earlier | None]]:
    """Give PETSc the options of a request, and of the run that it goes on from (collective)."""
    earlier = earlier_run(comm, request.resume, request.scene is not None)
    if earlier is not None:
        words = [*kept_options(earlier, request.petsc_words), *request.petsc_words]
        true_error = request.true_error or earlier.true_error or None
        request = replace(request, petsc_options=shlex.join(words), true_error=true_error)
    with (
        lent_options(comm, request.petsc_words),
        np.errstate(all="ignore"),
    ):  # a step tells of what overflows
        yield request, earlier


def frames(
    scene: Source,
    frames: int | None = None,
    *,
    set: Mapping[str, Any] | None = None,
    device: str | None = None,
    petsc_options: str | Mapping[str, Any] = "",
) -> Iterator[Frame]:
    """Yield the frames of a scene, frame 0 first, and write no file; see ``Simulation``.

    for frame in msmpetsc.frames("scene.toml", set={"material.young_modulus": 2e5}):
        print(frame.time, frame.position[:, 2].max())
    """
    return Simulation(scene, device=device, petsc_options=petsc_options).frames(frames, set=set)


class Simulation:
    """A scene that is run again and again, on all ranks; its lattice is kept while it may be.

    simulation = msmpetsc.Simulation("scene.toml")
    for modulus in (1e5, 2e5, 4e5):
        *_, last = simulation.frames(set={"material.young_modulus": modulus})

    Cages, embedding and the springs' network are kept while mesh and cages stay as they are;
    material, loads, starts and times may change from run to run.

    scene : as it was given
    model : of the run begun last: lattice, embedding, on rank 0 the surface; None before the first
    """

    def __init__(
        self,
        scene: Source,
        *,
        device: str | None = None,
        petsc_options: str | Mapping[str, Any] = "",
    ):
        """Read and check the scene; the mesh is read when the first run begins.

        scene         : a file's path, tables as in a file, or a Scene
        device        : "cpu" or "cuda"; cuda is -mat_type aijcusparse
        petsc_options : for its runs alone: "-ksp_rtol 1e-3", or {"ksp_rtol": 1e-3, "ksp_view": None}

        Raises InputError.
        """
        if device not in (None, "cpu", "cuda"):
            raise InputError(f"device is cpu or cuda, not {device!r}")
        self.comm, self.device = MPI.COMM_WORLD, device
        if not isinstance(scene, Scene):
            scene = Scene.of(scene) if isinstance(scene, Mapping) else Scene.load(scene)
        self.scene = scene
        self.model: Model | None = None
        self._words = words_of(petsc_options)
        self._shape: Geometry | None = None  # that the model was made of

    def __repr__(self) -> str:
        """Return one line: the scene, and the ranks that it is run on."""
        ranks = f"{self.comm.size} rank{'s' * (self.comm.size > 1)}"
        return f"Simulation({self.scene!r}, {self.device or 'cpu'}, {ranks})"

    def frames(
        self, frames: int | None = None, *, set: Mapping[str, Any] | None = None
    ) -> Iterator[Frame]:
        """Yield the frames of a run from the start, frame 0 first (collective).

        frames : stop after so many steps
        set    : changes of the scene for this run: {"time.step": 1e-3, "solver.preset": "newton"}

        Each frame has this rank's rows, the caller's own. To leave the loop early ends the run; all
        ranks must do so at the same frame. Raises InputError at once, and StepFailed, on all ranks.
        """
        scene = self.scene.changed(set or {})
        if frames is not None:
            if frames < 1:
                raise InputError(f"frames must be at least 1, not {frames}")
            scene = scene.changed({"time.duration": frames * scene.time.step})
        return self._steps(scene)

    def _steps(self, scene: Scene) -> Iterator[Frame]:
        with ExitStack() as until_the_end:
            with self._at_work():
                steps = self._begin(scene, until_the_end)
            while True:
                with self._at_work():
                    frame = next(steps, None)
                if frame is None:
                    return
                yield replace(frame, position=frame.position.copy())  # the next step needs these

    def _begin(self, scene: Scene, until_the_end: ExitStack) -> Iterator[Frame]:
        """Build what the run needs, or keep it, and return its steps (collective)."""
        start_for_runs(self.comm, self._words)
        from msmpetsc.solve import presets, refused_options, simulate
        from msmpetsc.solve.petsc.device import AIJCUSPARSE, OPTION, choose

        words = [*self._words, f"-{OPTION}", AIJCUSPARSE] if self.device == "cuda" else self._words
        alone = not +presets.in_use  # no other simulation is begun
        if words and not alone:
            raise InputError(
                "another simulation is under way: end it before one that has PETSc options or a device"
            )
        if words:
            until_the_end.enter_context(lent_options(self.comm, words))
        if alone:
            refused_options.refuse_early(self.comm)
        choose(self.comm, self.device)
        simulate.refuse_bad_options(scene)
        if self._shape is None or not self._shape.fits(scene):
            self._shape = Geometry(self.comm, scene)
        self.model = model = build_model(self.comm, scene, self._shape)
        loop = until_the_end.enter_context(simulate.TimeLoop(self.comm, scene, model))
        if alone:
            loop.refuse_unused_options()
        return loop.frames()

    @contextmanager
    def _at_work(self) -> Iterator[None]:
        """Show warnings on rank 0, and end all ranks at a failure, but not between frames."""
        with (
            logged_on_root(self.comm, logging.WARNING),
            ending_together(self.comm),
            np.errstate(all="ignore"),  # a step tells of what overflows
        ):
            yield
