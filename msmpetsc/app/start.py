"""The Python interface of runs. Modules that import PETSc are imported once it has its options."""

import atexit
import inspect
import logging
import shlex
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Literal, ParamSpec, TypeVar

import numpy as np
from mpi4py import MPI

from msmpetsc.app.abort import ending_together, logged_on_root
from msmpetsc.app.request import OPTIONS, RunRequest
from msmpetsc.app.resume import earlier_run, kept_options
from msmpetsc.build import Geometry, Model, build_model
from msmpetsc.comm import refuse_unlike_ranks
from msmpetsc.errors import STATUS_INTERRUPTED, InputError
from msmpetsc.fields import Frame
from msmpetsc.results.checkpoint_reader import Earlier, end_of_run
from msmpetsc.scene.reading import Scene
from msmpetsc.solve.petsc.initialise import lent_options, start_for_runs
from msmpetsc.solve.petsc.words import words_of

P = ParamSpec("P")
T = TypeVar("T")
# options of a run that may differ between ranks
OF_A_RANK = ("scene", "quiet", "on_frame")
# a scene file, tables, or a scene
Source = str | PathLike[str] | Mapping[str, Any] | Scene


def asked_by(request: Callable[P, object]) -> Callable[[Callable[..., T]], Callable[P, T]]:
    """Return a decorator that gives a function the signature of a request and its help texts."""

    def decorate(function: Callable[..., T]) -> Callable[P, T]:
        signature = inspect.signature(request).replace(
            return_annotation=function.__annotations__["return"]
        )
        # help() shows __signature__
        function.__signature__ = signature  # type: ignore[attr-defined]
        summary, _, sections = inspect.cleandoc(function.__doc__ or "").partition("\n\n")
        parameters = (f"{name} : optional\n    {option.help}" for name, option in OPTIONS.items())
        function.__doc__ = "\n".join(
            [summary, "", "Parameters", "----------", *parameters, "", sections]
        )
        return function

    return decorate


@asked_by(RunRequest)
def run(*values: Any, **keywords: Any) -> Path:
    """Run a scene as ``msmpetsc run`` does and return the path of its result (collective).

    Returns
    -------
    Path
        Path of the result file.

    Raises
    ------
    InputError
        The scene or an option cannot be used; raised on all ranks.
    StepFailed
        A time step failed; raised on all ranks.
    KeyboardInterrupt, SystemExit
        SIGINT or SIGTERM stopped the run; ``resume="OUT.h5"`` continues it.

    Examples
    --------
        path = msmpetsc.run("scene.toml", "out/x.h5", frames=10, set={"material.density": 900.0})
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
    """Run a request; return the exit status (collective)."""
    with options_given(comm, request) as (request, earlier):
        from msmpetsc.app.running import run_steps

        return run_steps(comm, request, earlier)


def options_shown(comm: MPI.Intracomm, request: RunRequest) -> list[str]:
    """Return the PETSc options of a run as lines of an options file (collective)."""
    with options_given(comm, request) as (request, earlier):
        from msmpetsc.app.running import lines_of_options

        return lines_of_options(comm, request, earlier)


@contextmanager
def options_given(
    comm: MPI.Intracomm, request: RunRequest
) -> Iterator[tuple[RunRequest, Earlier | None]]:
    """Give PETSc the options of a request and of the run that it resumes (collective).

    Yields the request with all options, and the earlier run or None.
    """
    # the scene of rank 0 is the run's
    asked = {name: getattr(request, name) for name in OPTIONS if name not in OF_A_RANK}
    refuse_unlike_ranks(comm, asked)
    earlier = earlier_run(comm, request.resume, request.scene is not None)
    if earlier is not None:
        words = [*kept_options(earlier, request.petsc_words), *request.petsc_words]
        true_error = request.true_error or earlier.true_error or None
        request = replace(request, petsc_options=shlex.join(words), true_error=true_error)
    # a step reports overflow itself
    with lent_options(comm, request.petsc_words), np.errstate(all="ignore"):
        yield request, earlier


def frames(
    scene: Source,
    frames: int | None = None,
    *,
    set: Mapping[str, Any] | None = None,
    device: Literal["cpu", "cuda"] | None = None,
    petsc_options: str | Mapping[str, Any] = "",
) -> Iterator[Frame]:
    """Yield the frames of a scene without writing a file (collective).

    Parameters
    ----------
    scene : path or mapping or Scene
        Scene file, tables as in a scene file, or a checked scene.
    frames : int, optional
        Stop after this number of steps.
    set : mapping, optional
        Changes of the scene, for example {"time.step": 1e-3}.
    device : {"cpu", "cuda"}, optional
        Device; "cuda" is -mat_type aijcusparse.
    petsc_options : str or mapping, optional
        PETSc options, for example "-ksp_rtol 1e-3" or {"ksp_rtol": 1e-3, "ksp_view": None}.

    Yields
    ------
    Frame
        The start as frame 0, then the frame of each step, as in ``Simulation.frames``.

    Examples
    --------
        for frame in msmpetsc.frames("scene.toml", set={"material.young_modulus": 2e5}):
            print(frame.time, frame.position[:, 2].max())
    """
    return Simulation(scene, device=device, petsc_options=petsc_options).frames(frames, set=set)


class Simulation:
    """A scene for several runs that share cages, embedding and the network of springs.

    A run builds these anew if the tables of meshes or cages have changed. Material, loads, starts
    and times may change from run to run. All methods are collective.

    Attributes
    ----------
    scene : Scene
        The scene without the changes of a run.
    model : Model or None
        Model of the last run: lattice, embedding and, on rank 0, the surface. None before the
        first run.

    Examples
    --------
        simulation = msmpetsc.Simulation("scene.toml")
        for modulus in (1e5, 2e5, 4e5):
            *_, last = simulation.frames(set={"material.young_modulus": modulus})
    """

    def __init__(
        self,
        scene: Source,
        *,
        device: Literal["cpu", "cuda"] | None = None,
        petsc_options: str | Mapping[str, Any] = "",
    ):
        """Read and check the scene; the first run reads the mesh.

        Parameters
        ----------
        scene, device, petsc_options
            As for ``msmpetsc.frames``; the options are of this simulation's runs only.

        Raises
        ------
        InputError
            The scene or an option cannot be used.
        """
        # raises InputError for an unknown device
        RunRequest(device=device)
        self.comm, self.device = MPI.COMM_WORLD, device
        if not isinstance(scene, Scene):
            scene = Scene.of(scene) if isinstance(scene, Mapping) else Scene.load(scene)
        self.scene = scene
        self.model: Model | None = None
        self._words = words_of(petsc_options)
        self._geometry: Geometry | None = None

    def __repr__(self) -> str:
        """Return the scene, the device and the number of ranks in a line."""
        ranks = f"{self.comm.size} rank{'s' * (self.comm.size > 1)}"
        return f"Simulation({self.scene!r}, {self.device or 'cpu'}, {ranks})"

    def frames(
        self, frames: int | None = None, *, set: Mapping[str, Any] | None = None
    ) -> Iterator[Frame]:
        """Yield the frames of a run from the start (collective).

        Leaving the loop early ends the run; all ranks must leave it at the same frame.

        Parameters
        ----------
        frames : int, optional
            Stop after this number of steps.
        set : mapping, optional
            Changes of the scene for this run, for example {"solver.preset": "newton"}.

        Yields
        ------
        Frame
            The start as frame 0, then the frame of each step. Arrays hold this rank's rows and
            belong to the caller.

        Raises
        ------
        InputError
            The changed scene cannot be used; raised at the call, on all ranks.
        StepFailed
            A time step failed; raised in the loop, on all ranks.
        """
        # raises InputError for a wrong number of frames
        RunRequest(frames=frames)
        scene = self.scene.changed(set or {})
        if frames is not None:
            scene = scene.changed({"time.duration": frames * scene.time.step})
        return self._steps(scene)

    def _steps(self, scene: Scene) -> Iterator[Frame]:
        """Yield the frames of a run and close its resources at the end (collective)."""
        with ExitStack() as resources:
            with self._guarded():
                # At exit, a process first closes the runs left open, then ends PETSc.
                atexit.register(resources.close)
                resources.callback(atexit.unregister, resources.close)
                steps = self._begin(scene, resources)
            while True:
                with self._guarded():
                    frame = next(steps, None)
                if frame is None:
                    return
                yield frame.with_own_positions()

    def _begin(self, scene: Scene, resources: ExitStack) -> Iterator[Frame]:
        """Build the model, reusing the geometry if it fits, and return the steps (collective)."""
        asked = {"scene": list(scene.leaves()), "petsc_options": self._words, "device": self.device}
        refuse_unlike_ranks(self.comm, asked)
        start_for_runs(self.comm, self._words)
        from msmpetsc.solve import presets, refused_options, simulate
        from msmpetsc.solve.petsc.device import AIJCUSPARSE, OPTION, choose

        words = [*self._words, f"-{OPTION}", AIJCUSPARSE] if self.device == "cuda" else self._words
        # whether no other simulation is under way; the plus drops counts of zero
        alone = not +presets.in_use
        if words and not alone:
            raise InputError(
                "another simulation is under way: end it before a run with PETSc options or a GPU"
            )
        if words:
            resources.enter_context(lent_options(self.comm, words))
        if alone:
            refused_options.refuse_early(self.comm)
        choose(self.comm, self.device)
        simulate.refuse_bad_options(scene)
        if self._geometry is None or not self._geometry.fits(scene):
            self._geometry = Geometry(self.comm, scene)
        read_state = partial(end_of_run, self.comm, scene.folder)
        self.model = model = build_model(self.comm, scene, self._geometry, read_state)
        loop = resources.enter_context(simulate.TimeLoop(self.comm, scene, model))
        if alone:
            loop.refuse_unused_options()
        return loop.frames()

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Log warnings on rank 0 and end all ranks at a failure in the block (collective).

        The block contains a step, but not the caller's loop: an error there ends no rank.
        """
        # a step reports overflow itself
        with (
            logged_on_root(self.comm, logging.WARNING),
            ending_together(self.comm),
            np.errstate(all="ignore"),
        ):
            yield
