"""What a film or a page shows when: its speed, its frames with their cameras, and the room that all of them take."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.results.progress import counted
from msmpetsc.results.reader import Result
from msmpetsc.view.camera import Camera, camera_facing, turned
from msmpetsc.view.colours import Colouring, colouring_of, plain_colouring
from msmpetsc.view.drawable import FARTHEST, Drawable
from msmpetsc.view.overlays import MARGIN, Overlays

FASTEST = 30.0  # pictures a second, where nothing is said
LENGTHS = 3.0, 8.0  # [s] that a film lasts, where nothing is said
STEPS = (1, 2, 5)  # times powers of ten: how much slower or faster


@dataclass(frozen=True)
class Playback:
    """How fast a film goes.

    numbers : which of the frames each picture shows
    fps     : pictures a second
    speed   : simulated seconds a second; 0 where time stands still
    """

    numbers: np.ndarray
    fps: float
    speed: float

    @property
    def seconds(self) -> float:
        """Length of the film [s]."""
        return len(self.numbers) / self.fps

    @property
    def words(self) -> str:
        """How fast time goes: "10 times slower than real", "" where it goes as it does or stands still."""
        if self.speed in (0.0, 1.0):
            return ""
        slower = self.speed < 1
        return f"{1 / self.speed if slower else self.speed:.3g} times {'slower' if slower else 'faster'} than real"


def usual_speed(span: float) -> float:
    """Return the simulated seconds a second at which a span [s] takes 3 to 8 s: 1, or what is round and nearest."""
    if not 0 < span < np.inf:
        return 1.0
    powers = 10.0 ** np.arange(20)
    factors = np.sort([step * power for step in STEPS for power in powers])
    least, most = LENGTHS
    if span < least:
        return float(1 / factors[np.argmax(span * factors >= least)])
    return float(factors[np.argmax(span / factors <= most)])


def playback_of(times: np.ndarray, fps: float | None = None, speed: float | None = None) -> Playback:
    """Return the playback of frames at these times (k,) [s].

    So that it lasts 3 to 8 s unless fps or speed says otherwise. With fps alone every frame is one picture; with both,
    or speed, each picture shows the frame nearest to its time. Raises InputError where time does not go on.
    """
    count = np.arange(len(times))
    steps = np.diff(times)
    if len(times) == 1 or not (steps > 0).all():
        if speed is not None:
            raise InputError("--speed needs frames in order of time, more than one")
        return Playback(count, fps or FASTEST / 3, 0.0)
    if fps is not None and speed is None:
        return Playback(count, fps, float(steps.mean() * fps))
    speed = speed or usual_speed(float(times[-1] - times[0]))
    fps = fps or max(1.0, min(FASTEST, speed / float(np.median(steps))))
    shown = times[0] + np.arange(0, (times[-1] - times[0]) * (1 + 1e-9) + speed / fps / 2, speed / fps)
    return Playback(abs(shown[:, None] - times).argmin(axis=1), fps, speed)


# Frames and cameras


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
class Extent:
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


def extent_of(subject: Drawable, frames: Sequence[int], style: Style, reference: Result | None = None) -> Extent:
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
    return Extent(everywhere, camera, colouring and replace(colouring, high=colouring.below or high), fixed)


def _directions() -> np.ndarray:
    """Return unit vectors (d, 3) spread over the sphere, those of the axes first (Fibonacci's spiral)."""
    number = np.arange(DIRECTIONS) + 0.5
    height, angle = 1 - 2 * number / DIRECTIONS, np.pi * (1 + 5**0.5) * number
    flat = np.sqrt(1 - height**2)
    spiral = np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=1)
    return np.concatenate([np.eye(3), -np.eye(3), spiral])


@dataclass(frozen=True)
class View:
    """One picture of a film: the number of its frame, its camera, and what stands beside the body."""

    index: int
    camera: Camera
    overlays: Overlays


def views_of(subject: Drawable, frames: Sequence[int], seen: Extent, turns: float = 0.0) -> list[View]:
    """Return a view for each frame; from the first to the last the eye goes so many times around the body."""
    angles = 2 * np.pi * turns * np.arange(len(frames)) / len(frames)
    cameras = [turned(seen.camera, angle) if turns else seen.camera for angle in angles]
    known: dict[int, Overlays] = {}
    views = []
    for index, camera in zip(frames, cameras, strict=True):
        if turns or index not in known:
            known[index] = subject.overlays(index, seen.extremes, camera)
        views.append(View(index, camera, known[index]))
    return views


def room_of(
    views: Iterable[View], seen: Extent, margin: float | np.ndarray = MARGIN
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return lower left (2,) and upper right (2,) of all views in their pictures' planes, and how deep they reach [m].

    Of a ground it is what lies below the bodies, their shadows. margin : around the bodies, of their longest extent
    """
    rows, reach = [], np.ptp(seen.box, axis=0).max()
    corners = [seen.extremes]
    for view in views:
        below = [ground.below(seen.extremes) for ground in view.overlays.grounds]
        flat = view.camera.flat(np.concatenate([seen.extremes, *below, *view.overlays.sharp]))
        rows += [flat.min(axis=0) - margin * reach, flat.max(axis=0) + margin * reach]
        corners.append(view.overlays.corners)
    depth = float(np.linalg.norm(np.ptp(np.concatenate(corners), axis=0)))
    return np.min(rows, axis=0), np.max(rows, axis=0), depth
