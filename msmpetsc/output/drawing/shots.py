"""The shots of a film or a page: how they are to look, what is seen at each, and how much room all of it takes."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.output.drawing.camera import Camera, camera_facing, turned
from msmpetsc.output.drawing.colouring import Colouring, colouring_of, plain_colouring
from msmpetsc.output.drawing.overlays import MARGIN, Overlays
from msmpetsc.output.drawing.subject import FARTHEST, Subject
from msmpetsc.output.progress import counted
from msmpetsc.output.reader import Result

DIRECTIONS = 40  # in which the points farthest out of a frame stand for all of it


@dataclass(frozen=True)
class Style:
    """How a picture, a film or a page is to look: what ``msmpetsc render`` is asked for, beside frames and files.

    eye       : direction (3,) from the body to the eye; the scene's picture.eye if None
    colour    : name of a field
    size      : width and height [px] of a film, a still, or a panel
    axes      : whether a box with lengths is drawn around the body
    scale_bar : whether the legend has a length
    shown     : "cells", "springs"
    """

    eye: Sequence[float] | None = None
    colour: str | None = None
    size: tuple[int, int] | None = None
    axes: bool = False
    scale_bar: bool = False
    shown: tuple[str, ...] = ()


@dataclass(frozen=True)
class Survey:
    """All frames that are drawn, as far as must be known before the first.

    extremes  : (e, 3) points that reach farthest in some direction at some frame [m]
    camera    : the first, before it turns
    colouring : with its scale; None for a plain body
    fixed     : whether any of the surface is ever pinned or led
    """

    extremes: np.ndarray
    camera: Camera
    colouring: Colouring | None
    fixed: bool

    @property
    def box(self) -> np.ndarray:
        """Corners (2, 3) of the box around all frames [m]."""
        return np.array([self.extremes.min(axis=0), self.extremes.max(axis=0)])


def survey(subject: Subject, frames: Sequence[int], style: Style, reference: Result | None = None) -> Survey:
    """Read the surfaces of the frames once, one at a time. Raises InputError where they cannot be drawn."""
    colouring = colouring_of(subject, style.colour, reference) if style.colour else plain_colouring(subject)
    directions = _directions()
    extremes, high = [], 0.0
    distinct = sorted(set(frames))
    for index in counted(distinct, "frames read"):
        points = subject.surface(index)
        if not (np.abs(points) < FARTHEST).all():
            raise InputError(f"{subject.name}: frame {index} has points that cannot be drawn")
        extremes.append(points[np.unique((points @ directions.T).argmax(axis=0))])
        if style.colour and colouring is not None:
            high = max(high, float(colouring.values(index).max(initial=0)))
    everywhere = np.concatenate(extremes)
    if np.ptp(everywhere, axis=0).max() == 0:
        raise InputError(f"{subject.name}: the surface at these frames has no extent")
    camera = camera_facing(everywhere, subject.gravity, subject.eye if style.eye is None else style.eye)
    fixed = any(subject.fixed(index).any() for index in (distinct[0], distinct[-1]))
    return Survey(everywhere, camera, colouring and replace(colouring, high=colouring.below or high), fixed)


def _directions() -> np.ndarray:
    """Return unit vectors (d, 3) spread over the sphere, those of the axes first (Fibonacci's spiral)."""
    number = np.arange(DIRECTIONS) + 0.5
    height, angle = 1 - 2 * number / DIRECTIONS, np.pi * (1 + 5**0.5) * number
    flat = np.sqrt(1 - height**2)
    spiral = np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=1)
    return np.concatenate([np.eye(3), -np.eye(3), spiral])


@dataclass(frozen=True)
class Shot:
    """One picture of a film: the number of its frame, its camera, and what stands beside the body."""

    index: int
    camera: Camera
    overlays: Overlays


def shots_of(subject: Subject, frames: Sequence[int], seen: Survey, turns: float = 0.0) -> list[Shot]:
    """Return a shot for each frame; from the first to the last the eye goes so many times around the body."""
    angles = 2 * np.pi * turns * np.arange(len(frames)) / len(frames)
    cameras = [turned(seen.camera, angle) if turns else seen.camera for angle in angles]
    known: dict[int, Overlays] = {}
    shots = []
    for index, camera in zip(frames, cameras, strict=True):
        if turns or index not in known:
            known[index] = subject.overlays(index, seen.extremes, camera)
        shots.append(Shot(index, camera, known[index]))
    return shots


def room_of(
    shots: Iterable[Shot], seen: Survey, margin: float | np.ndarray = MARGIN
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return lower left (2,) and upper right (2,) of all shots in their pictures' planes, and how deep they reach [m].

    Of a ground it is what lies below the bodies, their shadows. margin : around the bodies, of their longest extent
    """
    rows, reach = [], np.ptp(seen.box, axis=0).max()
    corners = [seen.extremes]
    for shot in shots:
        below = [ground.below(seen.extremes) for ground in shot.overlays.grounds]
        flat = shot.camera.flat(np.concatenate([seen.extremes, *below, *shot.overlays.sharp]))
        rows += [flat.min(axis=0) - margin * reach, flat.max(axis=0) + margin * reach]
        corners.append(shot.overlays.corners)
    depth = float(np.linalg.norm(np.ptp(np.concatenate(corners), axis=0)))
    return np.min(rows, axis=0), np.max(rows, axis=0), depth
