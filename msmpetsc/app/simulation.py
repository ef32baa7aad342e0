"""Simulations from Python: frames one by one, without a file, again and again on one lattice."""

import logging
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np
from mpi4py import MPI

from msmpetsc.app.ending import ending_together, logged_on_root
from msmpetsc.build import Geometry, Model, build_model
from msmpetsc.errors import InputError
from msmpetsc.fields import Frame
from msmpetsc.scene.reading import Scene
from msmpetsc.solve.petsc.initialise import lent_options, start_for_runs
from msmpetsc.solve.petsc.words import words_of

Source = str | PathLike[str] | Mapping[str, Any] | Scene  # a scene file, its tables, or a scene


def frames(
    scene: Source,
    frames: int | None = None,
    *,
    set: Mapping[str, Any] | None = None,
    preset: str | None = None,
    error: float | None = None,
    device: str | None = None,
    petsc_options: str | Mapping[str, Any] = "",
) -> Iterator[Frame]:
    """Yield the frames of a scene, frame 0 first, and write no file; the arguments are those of ``Simulation``.

    for frame in msmpetsc.frames("scene.toml", set={"material.young_modulus": 2e5}):
        print(frame.time, frame.position[:, 2].max())
    """
    simulation = Simulation(scene, device=device, petsc_options=petsc_options)
    return simulation.frames(frames, set=set, preset=preset, error=error)


class Simulation:
    """A scene that is run as often as one likes, on all ranks; its lattice is built anew only when it has to be.

    simulation = msmpetsc.Simulation("scene.toml")
    for modulus in (1e5, 2e5, 4e5):
        *_, last = simulation.frames(set={"material.young_modulus": modulus})

    Cages, embedding and the springs' network are kept while mesh and cages stay as they are;
    material, loads, starts and times may change from run to run.

    scene : as it was given
    model : of the run begun last: its lattice, embedding, and on rank 0 its surface; None before the first
    """

    def __init__(self, scene: Source, *, device: str | None = None, petsc_options: str | Mapping[str, Any] = ""):
        """Read and check the scene; the mesh is read when the first run begins.

        scene         : a file's path, tables as in a file, or a Scene
        device        : "cpu" or "cuda"; cuda is -mat_type aijcusparse
        petsc_options : "-ksp_rtol 1e-3 -ksp_view", or {"ksp_rtol": 1e-3, "ksp_view": None}, for its runs alone

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
        self._reached = "not begun"  # for people

    def __repr__(self) -> str:
        return f"Simulation({self.scene!r}, {self._reached})"

    def frames(
        self,
        frames: int | None = None,
        *,
        set: Mapping[str, Any] | None = None,
        preset: str | None = None,
        error: float | None = None,
    ) -> Iterator[Frame]:
        """Yield the frames of a run from the start, frame 0 first (collective).

        frames : stop after so many steps
        set    : changes of the scene for this run: {"material.young_modulus": 2e5, "pin.0.region": {...}}
        preset : solver preset, in place of the scene's
        error  : relative error of a step to aim at, in place of the scene's

        Each frame has this rank's rows, which are the caller's own. Leaving the loop early ends the run; all ranks
        must leave it at the same frame. Raises InputError at once, and while it runs StepFailed, on all ranks.
        """
        method = {"solver.preset": preset, "solver.error": error}
        changes = {key: value for key, value in method.items() if value is not None} | dict(set or {})
        scene = self.scene.changed(changes)
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
                self._reached = f"step {frame.index}, t = {frame.time:.6g} s"
                yield replace(frame, position=frame.position.copy())  # the next step starts from these numbers

    def _begin(self, scene: Scene, until_the_end: ExitStack) -> Iterator[Frame]:
        """Build what the run needs, or keep it, and return its steps (collective)."""
        start_for_runs(self.comm, self._words)
        from msmpetsc.solve import simulate
        from msmpetsc.solve.instrumentation import Probes

        alone = self._lend_options(until_the_end)
        simulate.refuse_bad_options(scene, Probes())
        if self._shape is None or not self._shape.fits(scene):
            self._shape = Geometry(self.comm, scene)
        self.model = model = build_model(self.comm, scene, self._shape)
        simulation = until_the_end.enter_context(simulate.TimeLoop(self.comm, scene, model))
        if alone:
            simulation.refuse_unused_options()
        return simulation.frames()

    def _lend_options(self, until_the_end: ExitStack) -> bool:
        """Lend PETSc these options; return whether no other simulation is begun (collective)."""
        from msmpetsc.solve.petsc.device import AIJCUSPARSE, OPTION, choose
        from msmpetsc.solve.presets import in_use
        from msmpetsc.solve.refused_options import refuse_early

        words = [*self._words, f"-{OPTION}", AIJCUSPARSE] if self.device == "cuda" else self._words
        alone = not +in_use
        if words and not alone:
            raise InputError("another simulation is under way: end it before one that has PETSc options or a device")
        if words:
            until_the_end.enter_context(lent_options(self.comm, words))
        if alone:
            refuse_early(self.comm)
        choose(self.comm, self.device)
        return alone

    @contextmanager
    def _at_work(self) -> Iterator[None]:
        """Show warnings on rank 0, and end all ranks at a failure, but not between frames."""
        with (
            logged_on_root(self.comm, logging.WARNING),
            ending_together(self.comm),
            np.errstate(all="ignore"),  # a step tells of what overflows
        ):
            yield
