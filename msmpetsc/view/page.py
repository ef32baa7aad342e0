"""A web page of a result in a single file: the mouse turns the body, a slider plays the frames.

page.html, page.css and page*.js contain layout and drawing; this module supplies the data.
Positions are 16-bit integers over the box around all frames. Each frame is stored as its difference
from the frame before, deflated and base64-encoded.
"""

import base64
import html
import json
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

import igl
import numpy as np

from msmpetsc.backend.arrays import Array, Floats
from msmpetsc.comm import log
from msmpetsc.geometry.surface import Surface
from msmpetsc.results.disk import write_whole
from msmpetsc.results.progress_bar import counted
from msmpetsc.view.annotations import entries_of
from msmpetsc.view.composition import Composition, Still, Style, composition_of
from msmpetsc.view.drawable import Drawable
from msmpetsc.view.film import usual_speed
from msmpetsc.view.mesh import drawn

# largest size of all frames before packing [byte]; frames beyond it are left out
MAX_BYTES = 30_000_000
# largest integer of a position
LEVELS: int = np.iinfo(np.uint16).max
PARTS = files("msmpetsc.view")
SCRIPTS = ("page.js", "page_drawing.js", "page_steering.js")


def write_page(subject: Drawable, path: Path, frames: Sequence[int], style: Style) -> None:
    """Write a page of these frames, or of a subset if they would exceed ``MAX_BYTES``.

    Raises InputError if the frames cannot be drawn or the page cannot be written.
    """
    subject = drawn(subject)
    step = -(-8 * len(subject.rest.points) * len(frames) // MAX_BYTES)
    chosen = [*frames[:-1:step], frames[-1]]
    if step > 1:
        log.info("%s has %d of the %d frames", path, len(chosen), len(frames))
    composition = composition_of(subject, chosen, style)
    streams = packed_frames(composition, chosen)
    facts = page_facts(composition, composition.stills(chosen))
    write_whole(path, page_text(composition.subject.title, facts, streams))


def packed_frames(composition: Composition, frames: Sequence[int]) -> dict[str, bytes]:
    """Return positions, colours, fixed shares and triangles as deflated bytes for the script."""
    subject = composition.subject
    low, high = composition.box
    scale = LEVELS / np.maximum(high - low, np.finfo(float).tiny)
    positions = (
        np.rint((subject.surface(index) - low) * scale).clip(0, LEVELS).astype("<u2")
        for index in counted(frames, "frames packed")
    )
    fixed = (np.rint(255 * subject.fixed(index)).astype(np.uint8) for index in frames)
    bits = "<u2" if len(subject.rest.points) <= LEVELS else "<u4"
    return {
        "positions": deflated(positions),
        "colours": deflated(map(composition.colouring.numbers, frames)),
        "fixed": deflated(fixed),
        "triangles": zlib.compress(subject.triangles.astype(bits).tobytes()),
    }


def deflated(frames: Iterable[Array]) -> bytes:
    """Return frames as deflated differences from the frame before; the integers wrap around."""
    packer = zlib.compressobj()
    parts = []
    before: Any = 0
    for frame in frames:
        parts.append(packer.compress((frame - before).tobytes()))
        before = frame
    return b"".join([*parts, packer.flush()])


def page_facts(composition: Composition, stills: Sequence[Still]) -> dict[str, Any]:
    """Return the script's data except the streams."""
    subject = composition.subject
    frames = [still.index for still in stills]
    return {
        "title": subject.title,
        "points": len(subject.rest.points),
        "box": composition.box,
        "times": subject.times[frames],
        "speed": usual_speed(float(np.ptp(subject.times[[frames[0], frames[-1]]]))),
        "camera": asdict(composition.camera),
        "scale": composition.colouring.table,
        "legend": [vars(entry) for entry in entries_of(composition, stills)],
        "overlays": [asdict(still.overlays) for still in stills],
        "solids": {number: solid_facts(solid) for number, solid in subject.solids.items()},
    }


def solid_facts(surface: Surface) -> dict[str, Floats]:
    """Return an obstacle's surface for the script: corners and their normals of each triangle."""
    corners = surface.points[surface.triangles]
    normals = igl.per_face_normals(surface.points, surface.triangles, np.zeros(3))
    largest = np.abs(corners).max(initial=np.finfo(float).tiny)
    digits = 6 - int(np.floor(np.log10(largest)))
    return {
        "corners": np.round(corners, digits).ravel(),
        "normals": np.round(np.repeat(normals, 3, axis=0), 3).ravel(),
    }


def page_text(title: str, facts: dict[str, Any], streams: dict[str, bytes]) -> str:
    """Return the text of the page, which loads no other file."""
    coded = {name: base64.b64encode(stream).decode() for name, stream in streams.items()}
    data = facts | {"streams": coded}
    text = json.dumps(data, separators=(",", ":"), default=np.ndarray.tolist)
    parts = {
        "title": html.escape(title),
        "css": (PARTS / "page.css").read_text(encoding="utf-8"),
        "script": "\n".join((PARTS / name).read_text(encoding="utf-8") for name in SCRIPTS),
        # a literal "</script>" would end the script
        "data": text.replace("<", "\\u003c"),
    }
    page = (PARTS / "page.html").read_text(encoding="utf-8")
    for name, part in parts.items():
        page = page.replace(f"{{{{ {name} }}}}", part)
    return page
