"""A contact sheet: some moments of a result in rows of one picture; or one of a scene or a mesh.

All panels are seen by one camera without perspective, drawn one by one and pasted: so scale and height can be compared
between them. Beside each body stand the obstacles and forces of its own time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from msmpetsc.errors import InputError
from msmpetsc.results.disk import whole_file
from msmpetsc.results.frame_choice import Frames, frames_of
from msmpetsc.results.reader import Result, plain_damage
from msmpetsc.scene.schema import SceneFile
from msmpetsc.view.annotations import CAPTION, Entry, caption_picture, entries_of, legend_picture, scale_bar
from msmpetsc.view.camera import Camera, camera_facing
from msmpetsc.view.colours import colouring_of, opened_reference, plain_colouring, scaled
from msmpetsc.view.drawable import FARTHEST, Drawable, drawable_of_result
from msmpetsc.view.mesh import cut_open, drawn
from msmpetsc.view.overlays import MARGIN
from msmpetsc.view.playback import Style
from msmpetsc.view.renderer import Panel, Renderer

PANEL, NARROWEST = (400, 870), 240  # [px]: at most, and the least that a caption needs
ROW = 2000  # [px]: wider ones are broken into several
HIGHEST = 32767  # [px]: where 16 bits end, and with them what many programs show
LONGEST_BAR = 0.4  # of a panel's width: a scale bar
LABELS = np.array([0.55, 0.15])  # of the bodies' longest extent: beside and above them, where axes are labelled


@dataclass(frozen=True)
class Moment:
    """One panel to be drawn: the number of its frame, two lines below it, and what is shown of the lattice."""

    index: int
    caption: tuple[str, str]
    shown: tuple[str, ...] = ()


def contact_sheet(
    h5_path: str | Path,
    png_path: str | Path,
    frames: Frames | None = None,
    count: int | None = None,
    eye: Sequence[float] | None = None,
    style: Style | None = None,
    reference: Path | None = None,
) -> Path:
    """Draw the surface at some moments of a result; return png_path.

    frames    : these, or (count) as many as `choose_moments` finds, or those at the scene's picture.times
    eye       : direction from the body to the eye (3,); the scene's picture.eye if None
    reference : result that the colour "error" is counted from
    """
    style = style or Style()
    style = style if eye is None else replace(style, eye=eye)
    with plain_damage(Path(h5_path)), Result(h5_path) as run, opened_reference(reference, run) as compared:
        subject = drawable_of_result(run)
        chosen = _moments(run, subject, frames, count)
        times = subject.times
        moments = [Moment(i, (f"t = {times[i]:.3f} s", text), style.shown) for i, text in chosen.items()]
        draw_moments(subject, Path(png_path), moments, style, compared)
    return Path(png_path)


def draw_moments(
    subject: Drawable, path: Path, moments: Sequence[Moment], style: Style, reference: Result | None = None
) -> None:
    """Draw a subject at some moments, side by side."""
    subject = drawn(subject)
    bodies = {moment.index: subject.surface(moment.index) for moment in moments}
    everywhere = np.concatenate(list(bodies.values()))
    if not (np.abs(everywhere) < FARTHEST).all() or np.ptp(everywhere, axis=0).max() == 0:
        raise InputError(f"{subject.name}: the surface at these moments has no extent, or none that can be drawn")
    camera = camera_facing(everywhere, subject.gravity, subject.eye if style.eye is None else style.eye)
    colouring = plain_colouring(subject)
    if style.colour:
        colouring = scaled(colouring_of(subject, style.colour, reference), bodies)
    axes = np.array([everywhere.min(axis=0), everywhere.max(axis=0)]) if style.axes else None
    panels = []
    for moment in moments:
        index, shown = moment.index, moment.shown
        overlays = subject.overlays(index, everywhere, camera)
        colours = colouring.rgb(index) if colouring else None
        lattice = cut_open(subject, camera, shown).meshes(subject.nodes(index)) if shown else ()
        panels.append(Panel(bodies[index], subject.fixed(index), overlays, moment.caption, colours, lattice, axes))
    fixed = any(panel.fixed.any() for panel in panels)
    every = tuple({name: None for moment in moments for name in moment.shown})
    entries = entries_of(subject.scene, fixed, [panel.overlays for panel in panels], colouring, every)
    draw(panels, subject.triangles, camera, path, style, entries)


def _moments(run: Result, subject: Drawable, frames: Frames | None, count: int | None) -> dict[int, str]:
    """Return the frames to draw, each with its reason or ""."""
    total = len(subject.times)
    assert isinstance(subject.scene, SceneFile)
    if frames:
        moments = dict.fromkeys(frames_of(subject.name, frames, total), "")
        refuse_high(len(moments))  # before the surfaces of all are read
        return moments
    if count is None and subject.scene.picture.times:
        return moments_at(run, subject.scene.picture.times)
    refuse_high(min(count or 0, total))
    return choose_moments(run, count or COUNT)


def draw(
    panels: list[Panel],
    triangles: np.ndarray,
    camera: Camera,
    path: Path,
    style: Style | None = None,
    entries: Sequence[Entry] = (),
) -> None:
    """Render the panels one by one, each with its caption, paste them in rows, and put the legend below.

    A graphics library's own pictures end at some width, and beyond it they are black.
    """
    style = style or Style()
    low, high = _frame(panels, camera)
    most = style.size or PANEL
    scale = min(most[0] / (high - low)[0], most[1] / (high - low)[1])  # [px/m]
    width, height = np.maximum([NARROWEST, 1], np.round(scale * (high - low))).astype(int)  # [px]
    rows = refuse_high(len(panels), (int(width), int(height) + CAPTION))
    columns = -(-len(panels) // rows)
    across, upward = (low + high) / 2
    shown = np.concatenate([points for panel in panels for points in (panel.points, panel.overlays.corners)])
    depth = float(np.linalg.norm(np.ptp(shown, axis=0)))  # nothing reaches farther towards the eye
    middle = across * camera.right + upward * camera.upward + shown[0] @ camera.to_eye * camera.to_eye
    sheet = np.full((rows, height + CAPTION, columns, width, 3), 255, np.uint8)
    with Renderer(int(width), int(height), triangles) as renderer:
        renderer.face(camera, middle, height / scale, depth)
        for number, panel in enumerate(panels):
            captioned = [renderer.picture(panel), caption_picture(panel.caption, int(width))]
            sheet[number // columns, :, number % columns] = np.concatenate(captioned)
    sheet = sheet.reshape(rows * (height + CAPTION), columns * width, 3)
    if style.scale_bar:
        entries = (*entries, scale_bar(scale, LONGEST_BAR * width))
    _save(np.concatenate([sheet, legend_picture(entries, sheet.shape[1])]), path)


def refuse_high(panels: int, size: tuple[int, int] = (NARROWEST, CAPTION)) -> int:
    """Return the rows in which panels of this size [px] stand. Raises InputError for more than programs would show."""
    width, height = size
    in_row = max(1, ROW // width)
    rows = -(-panels // in_row)
    if rows * height > HIGHEST:
        raise InputError(
            f"{panels} moments are too many for one picture: of panels of {width} by {height} pixels "
            f"at most {HIGHEST // height * in_row} fit into {in_row * width} by {HIGHEST}"
        )
    return rows


def _save(picture: np.ndarray, path: Path) -> None:
    try:
        with whole_file(path) as part:
            Image.fromarray(picture).save(part)
    except ValueError as error:  # of a format that Pillow does not know
        raise InputError(f"{path} cannot be written: {error}") from error


def _frame(panels: list[Panel], camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return lower left and upper right (2,), (2,) [m] of what every panel shows, in the picture's plane."""
    bodies = np.concatenate([panel.points for panel in panels])
    margin = (LABELS if panels[0].axes is not None else MARGIN) * np.ptp(bodies, axis=0).max()
    sharp = [points for panel in panels for points in panel.overlays.sharp]
    below = [ground.below(panel.points) for panel in panels for ground in panel.overlays.grounds]
    inner = camera.flat(np.concatenate([bodies, *below, *sharp]))
    return inner.min(axis=0) - margin, inner.max(axis=0) + margin


# The moments, where none are asked for


COUNT = 5  # moments, where nothing is said


def moments_at(run: Result, times: Sequence[float]) -> dict[int, str]:
    """Return the start, and the finished frames nearest to these times [s], in order of time."""
    time = run.frames.time[:]
    nearest = {0, *(int(np.argmin(abs(time - wanted))) for wanted in times)}
    return {index: "" if index else "start" for index in sorted(nearest)}


def choose_moments(run: Result, count: int) -> dict[int, str]:
    """Return at most `count` frames that tell the story, in order of time, each with its reason.

    In order of importance: the first and the last; the greatest elastic energy; before it the greatest kinetic
    energy (a falling body is fastest just before it touches the ground); after it the greatest potential energy
    (the top of the leap). Where these coincide, the middle of the longest gap between chosen frames is added.
    """
    kinetic, elastic, potential = (run.frames[name][:] for name in ("kinetic", "elastic", "potential"))
    total = len(elastic)
    most_elastic = int(np.argmax(elastic))
    fastest = int(np.argmax(kinetic[: most_elastic + 1]))
    highest = most_elastic + int(np.argmax(potential[most_elastic:]))
    moments = {0: "start", total - 1: "end"}
    for index, reason in (most_elastic, "most elastic energy"), (fastest, "fastest"), (highest, "highest"):
        if len(moments) < count:
            moments.setdefault(index, reason)
    while len(moments) < min(count, total):
        chosen = sorted(moments)
        widest = int(np.argmax(np.diff(chosen)))
        moments[(chosen[widest] + chosen[widest + 1]) // 2] = ""
    return dict(sorted(moments.items())[:count])
