"""The legend of a picture: what its colours mean, what is dark, what the arrows are, and how long a length is."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from msmpetsc.output.drawing.colouring import Colouring
from msmpetsc.output.drawing.colours import ARROW, CLASSES, FIXED, GLASS, GLASS_EDGE, INK, SPRING, on_scale
from msmpetsc.output.drawing.fabric import KINDS
from msmpetsc.output.drawing.lettering import font as letters_of
from msmpetsc.output.drawing.overlays import Overlays
from msmpetsc.scene.schema import SceneFile

if TYPE_CHECKING:  # a page has the entries without them
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont

LINE, GAP, LETTERS, BAR, SWATCH = 34, 36, 15, 150, 22  # [px]: a line's height, between entries, of type, of the bar
FINE = 3  # a legend is drawn so many times larger, and shrunk
NICE = (1, 2, 5)  # lengths of a scale bar, times powers of ten


@dataclass(frozen=True)
class Entry:
    """One entry: a bar of colours, a swatch, an arrow, a line or a length in front of a text.

    kind  : "bar", "swatch", "glass", "arrow", "line" or "length"
    width : of what stands in front of the text [px]
    low, high : numbers at the ends of a bar
    """

    kind: str
    text: str
    colour: str = INK
    width: float = SWATCH
    low: str = ""
    high: str = ""


def entries_of(
    scene: SceneFile | None, fixed: bool, overlays: list[Overlays], colouring: Colouring | None, shown: tuple[str, ...]
) -> list[Entry]:
    """Return the entries of what is drawn; fixed: whether any of the surface is pinned or led."""
    entries: list[Entry] = []
    if colouring is not None and colouring.classes:
        pairs = enumerate(colouring.classes)
        entries += [Entry("swatch", name, CLASSES[number % len(CLASSES)]) for number, name in pairs if name]
    elif colouring is not None:
        low, title, high = colouring.ends
        entries.append(Entry("bar", title, width=BAR, low=low, high=high))
    if "cells" in shown:
        entries += [Entry("swatch", text, colour) for colour, text in KINDS.values()]
    if "springs" in shown:
        entries.append(Entry("line", "spring", SPRING))
    if fixed and scene is not None:
        held = [word for kind, word in (("pin", "pinned"), ("anchor", "led")) if any(scene.tables(kind))]
        entries.append(Entry("swatch", " or ".join(held), FIXED))
    if any(shot.arrows for shot in overlays):
        entries.append(Entry("arrow", "force", ARROW, 30))
    if entries and any(shot.glass or shot.balls or shot.shapes for shot in overlays):
        entries.append(Entry("glass", "obstacle", GLASS))
    return entries


def scale_bar(scale: float, most: float) -> Entry:
    """Return a length that is round and as long as it may be; scale: [px/m]; most: [px]."""
    longest = most / scale
    power = 10.0 ** np.floor(np.log10(longest))
    length = max(step * power for step in NICE if step * power <= longest * (1 + 1e-9))
    for size, unit in ((1e3, "km"), (1.0, "m"), (1e-2, "cm"), (1e-3, "mm"), (1e-6, "µm")):
        if length >= size * (1 - 1e-9):
            return Entry("length", f"{length / size:.3g} {unit}", width=length * scale)
    return Entry("length", f"{length:.3g} m", width=length * scale)


def legend_picture(entries: Sequence[Entry], width: int, letters: float = 1.0) -> np.ndarray:
    """Return the entries side by side, in as many lines as they need: (height, width, 3), no lines for none.

    letters : their size, 1 in a sheet
    """
    from PIL import Image, ImageDraw

    room_of_line = round(width / letters)
    font = letters_of(FINE * LETTERS)
    lines: list[list[Entry]] = []
    room = 0.0
    for entry in entries:
        needed = _length(entry, font) + GAP
        if not lines or needed > room:
            lines.append([])
            room = room_of_line - GAP
        lines[-1].append(entry)
        room -= needed
    picture = Image.new("RGB", (FINE * room_of_line, FINE * LINE * len(lines)), "white")
    for number, line in enumerate(lines):
        left = (room_of_line - sum(_length(entry, font) + GAP for entry in line) + GAP) / 2
        for entry in line:
            _draw(ImageDraw.Draw(picture), entry, FINE * left, FINE * LINE * (number + 0.5), font)
            left += _length(entry, font) + GAP
    if not lines:
        return np.empty((0, width, 3), np.uint8)
    return np.array(picture.resize((width, round(letters * LINE * len(lines))), Image.Resampling.LANCZOS))


def _length(entry: Entry, font: "FreeTypeFont") -> float:
    """Return how long an entry is [px]."""
    return entry.width + sum(font.getlength(text) / FINE + 8 for text in (entry.text, entry.low, entry.high) if text)


def _draw(draw: "ImageDraw", entry: Entry, left: float, middle: float, font: "FreeTypeFont") -> None:
    """Draw an entry from `left` on, around `middle`, in fine pixels."""
    gap, half = 8 * FINE, 8 * FINE
    if entry.low:
        draw.text((left, middle), entry.low, INK, font, anchor="lm")
        left += font.getlength(entry.low) + gap
    right = left + FINE * entry.width
    box = (left, middle - half, right, middle + half)
    if entry.kind == "bar":
        for pixel in range(round(left), round(right)):
            colour = tuple(on_scale(np.array([(pixel - left) / (right - left)]))[0].astype(int))
            draw.line((pixel, middle - half, pixel, middle + half), colour)
    elif entry.kind == "swatch":
        draw.rectangle(box, entry.colour)
    elif entry.kind == "glass":
        draw.rectangle(box, "#e3e9ed", GLASS_EDGE, FINE)
    else:
        draw.line((left, middle, right - half * (entry.kind == "arrow"), middle), entry.colour, 2 * FINE)
    if entry.kind == "arrow":
        draw.polygon(
            [(right, middle), (right - 2 * half, middle - half), (right - 2 * half, middle + half)], entry.colour
        )
    if entry.kind == "length":
        for x in (left, right):
            draw.line((x, middle - half / 2, x, middle + half / 2), entry.colour, 2 * FINE)
    for text in filter(None, (entry.high, entry.text)):
        right += gap
        draw.text((right, middle), text, INK, font, anchor="lm")
        right += font.getlength(text)
