"""A page of a run that goes on: its newest frame, energies, errors and the time left, for a browser to look at.

A file and no server: it is written under another name and renamed, and loads itself again every few seconds.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from msmpetsc.comm import log
from msmpetsc.errors import one_line
from msmpetsc.model.fields import Frame
from msmpetsc.output.disk import write_whole
from msmpetsc.output.drawing.camera import camera_facing
from msmpetsc.output.drawing.colouring import plain_colouring
from msmpetsc.output.drawing.page import fixed_states, packed_frames, page_facts, page_text
from msmpetsc.output.drawing.shots import Style, Survey, shots_of
from msmpetsc.output.drawing.skin import drawn
from msmpetsc.output.drawing.subject import subject_of_surface
from msmpetsc.output.progress import duration

if TYPE_CHECKING:
    from msmpetsc.geometry.surface import Surface
    from msmpetsc.scene.schema import Scene

REFRESH = 4  # [s] after which the page loads itself again
EVERY = 3.0, 0.01  # at the most every so many seconds, and this part of the time
ENERGIES = ("kinetic", "elastic", "potential", "contact")
MOST_POINTS = 400  # of a curve: where there are more, every second one is left out


class LivePage:
    """The page of one run, written on one rank. What fails in it is told once, and never ends the run.

    Call update(frame) for every frame, and end() at the end, whatever the end.
    """

    def __init__(
        self,
        path: Path,
        scene: "Scene",
        surface: "Surface | None",
        newest: Callable[[], np.ndarray | None],
        body: np.ndarray | None = None,
        solids: Mapping[int, "Surface"] | None = None,
    ):
        """Make a page for a run of a scene.

        surface : at rest; newest : returns the surface points (v, 3) of the newest frame [m], None where none is stored
        body    : (v,) numbers of the bodies of these points; None: there is but one
        solids  : surfaces of obstacles that are meshes or functions, by their numbers
        """
        self._path, self._scene, self._newest = path, scene, newest
        self._subject = None if surface is None else subject_of_surface(path, surface, scene, body, solids)
        self._box = np.empty((0, 3))  # corners of the box around all frames drawn so far
        self._frame: Frame | None = None
        self._begun: tuple[float, int] | None = None  # when the first frame came [s], and its index
        self._series: list[list[float]] = []  # time and energies of frames
        self._thinned, self._seen = 1, 0  # every so many-th frame is in the series; frames so far
        self._due, self._failed = 0.0, False

    def update(self, frame: Frame) -> None:
        """Note a frame, and write the page if that is due."""
        self._frame, self._begun = frame, self._begun or (perf_counter(), frame.index)
        if self._seen % self._thinned == 0:
            self._series.append([frame.time, *(getattr(frame, name) for name in ENERGIES)])
        self._seen += 1
        if len(self._series) > MOST_POINTS:
            self._series, self._thinned = self._series[::2], 2 * self._thinned
        if perf_counter() >= self._due:
            self._write(ended=False)

    def end(self) -> None:
        """Write the page for the last time: it says how far the run came, and loads itself no more."""
        self._write(ended=True)

    def _write(self, ended: bool) -> None:
        if self._failed or self._frame is None:
            return
        began = perf_counter()
        try:
            write_whole(self._path, self._text(self._frame, ended))
        except Exception as error:  # whatever it is: the run goes on without its page
            self._failed = True
            log.warning("%s is not kept any further: %s", self._path, one_line(error))
        spent = perf_counter() - began
        self._due = perf_counter() + max(EVERY[0], spent / EVERY[1])

    def _text(self, frame: Frame, ended: bool) -> str:
        """Return the text of the page; without a body where no surface is stored."""
        title = self._scene.title or self._path.stem
        about = {"run": self._about(frame, ended)}
        points = self._newest()
        if self._subject is None or points is None:
            return page_text(title, about, {})
        rest = self._subject.rest.points
        subject = drawn(
            replace(self._subject, times=np.array([frame.time]), nodes=lambda _: points, surface=lambda _: points)
        )
        every = np.concatenate([self._box, points, rest] if not len(self._box) else [self._box, points])
        self._box = np.array([every.min(axis=0), every.max(axis=0)])
        corners = np.array([[self._box[i, 0], self._box[j, 1], self._box[k, 2]] for i, j, k in np.ndindex(2, 2, 2)])
        fixed = bool(subject.fixed(0).any())
        seen = Survey(corners, camera_facing(rest, subject.gravity, subject.eye), plain_colouring(subject), fixed)
        streams = packed_frames(subject, [0], seen)
        streams["fixed"], numbers = fixed_states(subject, [0])
        facts = page_facts(subject, shots_of(subject, [0], seen), seen, Style())
        return page_text(title, facts | about | {"fixed": numbers}, streams)

    def _about(self, frame: Frame, ended: bool) -> dict[str, Any]:
        """Return the rows and curves that stand beside the body."""
        total = self._scene.time.steps
        state = "finished" if frame.index == total else "ended" if ended else "running"
        rows = {"run": state, "step": f"{frame.index} of {total}", "time": f"{frame.time:.4g} s"}
        begun, first = self._begun or (0.0, 0)
        spent, steps = perf_counter() - begun, frame.index - first
        rows["computed for"] = duration(spent)
        if state == "running" and steps:
            rows["left"] = duration(spent / steps * (total - frame.index))
        rows |= {name: f"{getattr(frame, name):.4g} J" for name in ENERGIES}
        rows["error of a step"], rows["its"] = f"{frame.step_error:.1e}", str(frame.ksp_its)
        refresh = 0 if state == "finished" or ended else REFRESH
        curves = [[float(f"{number:.5g}") for number in row] for row in self._series]
        return {"rows": rows, "names": ["time", *ENERGIES], "curves": curves, "refresh": refresh}
