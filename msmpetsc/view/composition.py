"""The composition of pictures, films and pages: one camera, scale and extent for all."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyvista as pv

from msmpetsc.backend.arrays import Floats, Positions
from msmpetsc.errors import InputError
from msmpetsc.results.progress_bar import counted
from msmpetsc.view.camera import Camera, camera_facing
from msmpetsc.view.colours import Colouring, colouring_of, scaled
from msmpetsc.view.drawable import FARTHEST, Drawable
from msmpetsc.view.mesh import Cut, cut_open
from msmpetsc.view.overlays import MARGIN, Overlays, overlays_at


@dataclass(frozen=True)
class Style:
    """The look of a picture, film or page as ``msmpetsc render`` is asked for it.

    eye    : direction (3,) from the body to the eye; the scene's picture.eye if None
    colour : name of a field
    size   : width and height [px] of a film, a still, or a panel
    cells  : whether the body is cut open
    """

    eye: Sequence[float] | None = None
    colour: str | None = None
    size: tuple[int, int] | None = None
    cells: bool = False


@dataclass(frozen=True)
class Still:
    """One picture: number of its frame, obstacles and forces, a caption of two lines, and cells shown."""

    index: int
    overlays: Overlays
    caption: tuple[str, str] = ("", "")
    cut: Cut | None = None


@dataclass(frozen=True)
class Composition:
    """All frames to be drawn of a subject, with the camera, colours and extent that they share.

    extremes  : (e, 3) points that reach farthest in some direction at some frame [m]
    camera    : of all stills
    colouring : with its scale
    """

    subject: Drawable
    style: Style
    extremes: Positions
    camera: Camera
    colouring: Colouring

    @property
    def box(self) -> Positions:
        """Corners (2, 3) of the box around all frames [m]."""
        return np.array([self.extremes.min(axis=0), self.extremes.max(axis=0)])

    def stills(self, frames: Sequence[int], words: str = "") -> list[Still]:
        """Return the still of each frame, with its time and `words` in the caption."""
        cut = cut_open(self.subject, self.camera) if self.style.cells else None
        stills = []
        for index in frames:
            overlays = overlays_at(self.subject, index, self.extremes, self.camera)
            stills.append(Still(index, overlays, (f"t = {self.subject.times[index]:.3f} s", words), cut))
        return stills

    def room(self, stills: Sequence[Still]) -> tuple[Floats, Floats, float]:
        """Return lower left (2,) and upper right (2,) of all stills in the picture's plane, and their depth [m].

        With a margin. Of a ground only the shadows of the bodies count.
        """
        margin = MARGIN * np.ptp(self.box, axis=0).max()
        ends, corners = [], [self.extremes]
        for still in stills:
            shown = still.overlays
            below = [ground.below(self.extremes) for ground in shown.grounds]
            flat = self.camera.flat(np.concatenate([self.extremes, *below, *shown.arrows, shown.obstacles]))
            ends += [flat.min(axis=0) - margin, flat.max(axis=0) + margin]
            corners += [shown.obstacles, *(ground.corners for ground in shown.grounds)]
        depth = float(np.linalg.norm(np.ptp(np.concatenate(corners), axis=0)))
        return np.min(ends, axis=0), np.max(ends, axis=0), depth


def composition_of(subject: Drawable, frames: Sequence[int], style: Style) -> Composition:
    """Return the composition of frames, which are read one at a time. Raises InputError."""
    colouring = colouring_of(subject, style.colour)
    # the points farthest out in these directions stand for all of a frame
    directions = np.concatenate([np.eye(3), -np.eye(3), pv.Icosphere(nsub=1).points])
    extremes = []
    distinct = sorted(set(frames))
    for index in counted(distinct, "frames read"):
        points = subject.surface(index)
        if not (np.abs(points) < FARTHEST).all():
            raise InputError(f"{subject.name}: frame {index} has points that cannot be drawn")
        extremes.append(points[np.unique((points @ directions.T).argmax(axis=0))])
    everywhere = np.concatenate(extremes)
    if np.ptp(everywhere, axis=0).max() == 0:
        raise InputError(f"{subject.name}: the surface at these frames has no extent")
    gravity = subject.scene.gravity
    pull = gravity.acceleration if gravity else None
    camera = camera_facing(everywhere, pull, style.eye or subject.scene.picture.eye)
    return Composition(subject, style, everywhere, camera, scaled(colouring, subject, distinct))
