"""Text in pictures: captions, labels and the legend, all in one typeface."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from msmpetsc.backend.arrays import Array
from msmpetsc.view.colours import ARROW, CLASSES, FIXED, GLASS, GLASS_EDGE, INK, SCALE_TABLE
from msmpetsc.view.composition import Composition, Still
from msmpetsc.view.mesh import KINDS

CAPTION, LINES = (
    68,
    ((21, 22), (16, 50)),
)  # [px]: height of a caption; of its lines, size and middle


@cache
def typeface(size: int) -> ImageFont.FreeTypeFont:
    """Return the font DejaVu Sans, which comes with matplotlib, in a size [px]."""
    return ImageFont.truetype(
        str(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")), size
    )


def caption_picture(caption: tuple[str, str], width: int, letters: float = 1.0) -> Array:
    """Return the picture (height, width, 3) of two centred lines; letters: their size, 1 in a sheet."""
    picture = Image.new("RGB", (width, round(letters * CAPTION)), "white")
    for text, (size, middle) in zip(caption, LINES, strict=True):
        at = width / 2, letters * middle
        ImageDraw.Draw(picture).text(at, text, INK, typeface(round(letters * size)), anchor="mm")
    return np.array(picture)


LINE, GAP, LETTERS = 34, 36, 15  # [px]: a line's height, between entries, of type
# Widths of the signs in front of a text [px]
WIDTHS = {"bar": 220, "swatch": 22, "glass": 22, "arrow": 30, "note": 0}
# Rows of a bar, rows of a tick, middle and size of a tick's number [px]
BAR, TICK, NUMBER = (5, 17), (14, 20), (27, 12)
FINE = 3  # a legend is drawn so many times larger, and shrunk


@dataclass(frozen=True)
class Entry:
    """A legend entry: a bar of colours, a swatch, or an arrow in front of a text.

    kind  : "bar", "swatch", "glass", "arrow" or, for a text alone, "note"
    ticks : of a bar, shares of its width and the numbers there
    """

    kind: str
    text: str
    colour: str = INK
    ticks: tuple[tuple[float, str], ...] = ()


def entries_of(composition: Composition, stills: Sequence[Still]) -> list[Entry]:
    """Return the legend's entries for some stills."""
    scene, colouring = composition.subject.scene, composition.colouring
    entries: list[Entry] = []
    if colouring.classes:
        pairs = enumerate(colouring.classes)
        entries += [
            Entry("swatch", name, CLASSES[number % len(CLASSES)]) for number, name in pairs if name
        ]
    else:
        entries.append(Entry("bar", colouring.label, ticks=colouring.ticks))
    kinds = {kind for still in stills if still.cut for kind in still.cut}
    entries += [
        Entry("swatch", text, colour) for kind, (colour, text) in KINDS.items() if kind in kinds
    ]
    if any(composition.subject.fixed(still.index).any() for still in (stills[0], stills[-1])):
        held = [
            word for kind, word in (("pin", "pinned"), ("anchor", "led")) if any(scene.tables(kind))
        ]
        entries.append(Entry("swatch", " or ".join(held), FIXED))
    if any(still.overlays.arrows for still in stills):
        entries.append(Entry("arrow", "force", ARROW))
    if entries and any(len(still.overlays.obstacles) for still in stills):
        entries.append(Entry("glass", "obstacle", GLASS))
    if composition.note:
        entries.append(Entry("note", composition.note))
    return entries


def legend_picture(entries: Sequence[Entry], width: int, letters: float = 1.0) -> Array:
    """Return the picture (height, width, 3) of legend entries side by side, in as many lines as they need.

    letters : their size, 1 in a sheet
    """
    room = FINE * round(width / letters)
    lines: list[list[Image.Image]] = []
    for entry in map(_entry_picture, entries):
        if not lines or sum(each.width for each in (*lines[-1], entry)) > room:
            lines.append([])
        lines[-1].append(entry)
    if not lines:
        return np.empty((0, width, 3), np.uint8)
    picture = Image.new("RGB", (room, FINE * LINE * len(lines)), "white")
    for number, line in enumerate(lines):
        left = (room - sum(each.width for each in line)) // 2
        for entry in line:
            picture.paste(entry, (left, FINE * LINE * number))
            left += entry.width
    return np.array(
        picture.resize((width, round(letters * LINE * len(lines))), Image.Resampling.LANCZOS)
    )


def _entry_picture(entry: Entry) -> Image.Image:
    """Return the picture of a legend entry in fine pixels, with half a gap on either side."""
    font, middle, left = typeface(FINE * LETTERS), FINE * LINE / 2, FINE * GAP / 2
    half, gap = 8 * FINE, (18 if entry.ticks else 8) * FINE  # beside the number of the last tick
    width = FINE * WIDTHS[entry.kind]
    right = left + width
    picture = Image.new(
        "RGB", (round(right + gap + font.getlength(entry.text) + left), FINE * LINE), "white"
    )
    draw = ImageDraw.Draw(picture)
    box = (left, middle - half, right, middle + half)
    if entry.kind == "bar":
        top, bottom = (FINE * row for row in BAR)
        for pixel in range(round(left), round(right)):
            colour = tuple(SCALE_TABLE[int(255 * (pixel - left) / width)].tolist())
            draw.line((pixel, top, pixel, bottom), colour)
        row, size = (FINE * number for number in NUMBER)
        for share, number in entry.ticks:
            at = left + share * width
            draw.line((at, FINE * TICK[0], at, FINE * TICK[1]), INK, FINE)
            draw.text((at, row), number, INK, typeface(size), anchor="mm")
    elif entry.kind == "swatch":
        draw.rectangle(box, entry.colour)
    elif entry.kind == "glass":
        draw.rectangle(box, "#e3e9ed", GLASS_EDGE, FINE)
    elif entry.kind == "arrow":
        draw.line((left, middle, right - half, middle), entry.colour, 2 * FINE)
        draw.polygon(
            [(right, middle), (right - 2 * half, middle - half), (right - 2 * half, middle + half)],
            entry.colour,
        )
    draw.text((right + gap, middle), entry.text, INK, font, anchor="lm")
    return picture
