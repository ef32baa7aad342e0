"""The composition of pictures, films and pages: a common camera, colour scale and extent."""

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

# smallest margin around the view, relative to its longer side
LEAST_MARGIN = 0.01


@dataclass(frozen=True)
class Style:
    """The appearance of a picture, film or page, as the options of ``msmpetsc render`` set it.

    eye    : direction (3,) from the body to the eye; the scene's picture.eye if None
    colour : name of a field
    size   : width and height [px] of a film, a still or a panel
    cells  : whether to cut the body open and show its cells
    """

    eye: Sequence[float] | None = None
    colour: str | None = None
    size: tuple[int, int] | None = None
    cells: bool = False


@dataclass(frozen=True)
class Still:
    """A picture to draw of a frame.

    index    : number of the frame
    overlays : obstacles and force arrows
    caption  : two lines of text
    cut      : cells to show; None for the whole surface
    """

    index: int
    overlays: Overlays
    caption: tuple[str, str] = ("", "")
    cut: Cut | None = None


@dataclass(frozen=True)
class Composition:
    """The common camera, colours and extent of the frames of a subject that are drawn.

    extremes  : outermost points (e, 3) of all frames, in a set of directions [m]
    colouring : field with its scale
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
        """Return the still of each frame, with a caption of its time and ``words``."""
        cut = cut_open(self.subject, self.camera) if self.style.cells else None
        stills = []
        for index in frames:
            overlays = overlays_at(self.subject, index, self.extremes, self.camera)
            stills.append(Still(index, overlays, (self.subject.moment(index), words), cut))
        return stills

    def room(self, stills: Sequence[Still]) -> tuple[Floats, Floats, float]:
        """Return the corners (2,), (2,) of the view that contains all stills, and its depth [m].

        The corners are lower left and upper right in the picture's plane, with the margin. A ground
        counts only as far as the shadows of the bodies reach.
        """
        sides = np.ptp(self.camera.flat(self.extremes), axis=0)
        margin = np.maximum(MARGIN * sides, LEAST_MARGIN * sides.max())
        ends = []
        corners = [self.extremes]
        for still in stills:
            shown = still.overlays
            below = [ground.below(self.extremes) for ground in shown.grounds]
            flat = self.camera.flat(
                np.concatenate([self.extremes, *below, *shown.arrows, shown.obstacles])
            )
            ends += [flat.min(axis=0) - margin, flat.max(axis=0) + margin]
            corners += [shown.obstacles, *(ground.corners for ground in shown.grounds)]
        depth = float(np.linalg.norm(np.ptp(np.concatenate(corners), axis=0)))
        return np.min(ends, axis=0), np.max(ends, axis=0), depth


def composition_of(subject: Drawable, frames: Sequence[int], style: Style) -> Composition:
    """Read frames one after another and return their composition.

    Raises InputError if they cannot be drawn.
    """
    colouring = colouring_of(subject, style.colour)
    # the outermost points in these directions represent the extent
    directions = np.concatenate([np.eye(3), -np.eye(3), pv.Icosphere(nsub=1).points]).T
    extremes: list[Positions] = []
    distinct = sorted(set(frames))
    for index in counted(distinct, "frames read"):
        points = subject.surface(index)
        if not (np.abs(points) < FARTHEST).all():
            raise InputError(f"{subject.name}: frame {index} has points that cannot be drawn")
        extremes.append(points[np.unique((points @ directions).argmax(axis=0))])
    shown = np.concatenate(extremes)
    if np.ptp(shown, axis=0).max() == 0:
        raise InputError(f"{subject.name}: the surface at these frames has no extent")
    gravity = subject.scene.gravity
    pull = gravity.acceleration if gravity else None
    camera = camera_facing(shown, pull, style.eye or subject.scene.picture.eye)
    return Composition(subject, style, shown, camera, scaled(colouring, subject, distinct))
