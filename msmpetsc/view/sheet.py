"""Contact sheets: rows of pictures of a result at some times, or of a scene before its first step.

A common orthographic camera makes lengths comparable between the panels. Each panel shows the
obstacles and forces at its own time.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from msmpetsc.results.disk import whole_file
from msmpetsc.results.frame_choice import Frames, frames_of
from msmpetsc.results.reader import Result
from msmpetsc.results.untrusted_file import plain_damage
from msmpetsc.view.annotations import CAPTION, caption_picture, entries_of, legend_picture
from msmpetsc.view.composition import Composition, Still, Style, composition_of
from msmpetsc.view.drawable import Drawable, drawable_of_result
from msmpetsc.view.mesh import drawn
from msmpetsc.view.renderer import Renderer

# largest width and height of a panel, and least width for a caption [px]
PANEL, NARROWEST = np.array([400, 870]), 240
# width of the sheet above which panels are broken into rows [px]
ROW = 2000
# default number of pictures
COUNT = 5


def contact_sheet(
    h5_path: str | Path,
    png_path: str | Path,
    frames: Frames | None = None,
    count: int | None = None,
    style: Style | None = None,
) -> Path:
    """Draw a result's surface at some frames as a PNG file; return ``png_path``.

    frames : frame numbers; by default the frames at the scene's picture.times, if it has any
    count  : number of frames that ``choose_moments`` selects, if ``frames`` is not given

    Raises InputError if the result cannot be read or drawn.
    """
    style = style or Style()
    with plain_damage(Path(h5_path)), Result(h5_path) as run:
        subject = drawable_of_result(run)
        chosen = _moments(run, subject, frames, count)
        composition = composition_of(drawn(subject), list(chosen), style)
        pairs = zip(composition.stills(list(chosen)), chosen.values(), strict=True)
        stills = [replace(still, caption=(still.caption[0], text)) for still, text in pairs]
        draw_panels(composition, stills, png_path)
    return Path(png_path)


def draw_panels(composition: Composition, stills: Sequence[Still], path: str | Path) -> None:
    """Draw stills of a composition in rows of panels above the legend.

    Each panel is rendered separately, because graphics libraries limit the width of a window.
    """
    low, high, _ = composition.room(stills)
    # [px/m]
    scale = ((composition.style.size or PANEL) / (high - low)).min()
    width, height = np.maximum([NARROWEST, 1], np.rint(scale * (high - low)).astype(int)).tolist()
    rows = -(-len(stills) // max(1, ROW // width))
    columns = -(-len(stills) // rows)
    sheet = np.full((rows, height + CAPTION, columns, width, 3), 255, np.uint8)
    with Renderer(composition, stills, (width, height)) as renderer:
        for number, still in enumerate(stills):
            captioned = [renderer.picture(still), caption_picture(still.caption, width)]
            sheet[number // columns, :, number % columns] = np.concatenate(captioned)
    sheet = sheet.reshape(rows * (height + CAPTION), columns * width, 3)
    entries = entries_of(composition, stills)
    legend = legend_picture(entries, columns * width)
    with whole_file(Path(path)) as part:
        Image.fromarray(np.concatenate([sheet, legend])).save(part)


def _moments(
    run: Result, subject: Drawable, frames: Frames | None, count: int | None
) -> dict[int, str]:
    """Return the frames to draw, each with the reason for its choice or ""."""
    if frames:
        return dict.fromkeys(frames_of(subject.name, frames, len(subject.times)), "")
    if count is not None or not subject.scene.picture.times:
        return choose_moments(run, count or COUNT)
    wanted = np.array(subject.scene.picture.times)[:, None]
    nearest = {0, *abs(subject.times - wanted).argmin(axis=1).tolist()}
    return {index: "" if index else "start" for index in sorted(nearest)}


def choose_moments(run: Result, count: int) -> dict[int, str]:
    """Return at most ``count`` characteristic frames in order of time, each with its reason.

    The first and the last frame have priority, then the greatest elastic energy. Next come the
    greatest kinetic energy before it (contact of a falling body) and the greatest potential energy
    after it (top of the bounce). Remaining frames halve the longest gaps between chosen frames.
    """
    total = len(run.frames)
    most_elastic = int(run.frames.elastic[:].argmax())
    fastest = int(run.frames.kinetic[: most_elastic + 1].argmax())
    highest = most_elastic + int(run.frames.potential[most_elastic:].argmax())
    moments = {0: "start", total - 1: "end"}
    reasons = (most_elastic, "most elastic energy"), (fastest, "fastest"), (highest, "highest")
    for index, reason in reasons:
        if len(moments) < count:
            moments.setdefault(index, reason)
    while len(moments) < min(count, total):
        chosen = sorted(moments)
        widest = int(np.argmax(np.diff(chosen)))
        moments[(chosen[widest] + chosen[widest + 1]) // 2] = ""
    return dict(sorted(moments.items())[:count])
