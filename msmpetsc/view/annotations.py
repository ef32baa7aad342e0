"""Text in pictures: captions and the legend, in a common typeface."""

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

# height of a caption; type size and middle of each of its lines [px]
CAPTION, LINES = 68, ((21, 22), (16, 50))


@cache
def typeface(size: int) -> ImageFont.FreeTypeFont:
    """Return the font DejaVu Sans, which comes with matplotlib, in a size [px]."""
    return ImageFont.truetype(
        str(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")), size
    )


def caption_picture(caption: tuple[str, str], width: int, letters: float = 1.0) -> Array:
    """Return the picture (height, width, 3) of two centred lines.

    letters : scale of the type, 1 in a contact sheet
    """
    picture = Image.new("RGB", (width, round(letters * CAPTION)), "white")
    for text, (size, middle) in zip(caption, LINES, strict=True):
        at = width / 2, letters * middle
        ImageDraw.Draw(picture).text(at, text, INK, typeface(round(letters * size)), anchor="mm")
    return np.array(picture)


# a legend's line height, gap between entries, and type size [px]
LINE, GAP, TYPE_SIZE = 34, 36, 15
# width of the symbol in front of an entry's text [px]
WIDTHS = {"bar": 220, "swatch": 22, "glass": 22, "arrow": 30}
# first and last row of a bar and of a tick; middle and type size of its number [px]
BAR, TICK, NUMBER = (5, 17), (14, 20), (27, 12)
# factor by which a legend is drawn larger before it is reduced [-]; for smooth edges
SUPERSAMPLING = 3


@dataclass(frozen=True)
class Entry:
    """A legend entry: a symbol and a text.

    kind  : "bar" of colours, "swatch", "glass" or "arrow"
    ticks : position in [0, 1] and number of each tick of a bar
    """

    kind: str
    text: str
    colour: str = INK
    ticks: tuple[tuple[float, str], ...] = ()


def entries_of(composition: Composition, stills: Sequence[Still]) -> list[Entry]:
    """Return the legend's entries for some stills."""
    scene = composition.subject.scene
    colouring = composition.colouring
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
        words = [
            word for kind, word in (("pin", "pinned"), ("anchor", "led")) if any(scene.tables(kind))
        ]
        entries.append(Entry("swatch", " or ".join(words), FIXED))
    if any(still.overlays.arrows for still in stills):
        entries.append(Entry("arrow", "force", ARROW))
    if entries and any(len(still.overlays.obstacles) for still in stills):
        entries.append(Entry("glass", "obstacle", GLASS))
    return entries


def legend_picture(entries: Sequence[Entry], width: int, letters: float = 1.0) -> Array:
    """Return the picture (height, width, 3) of legend entries, wrapped into lines.

    letters : scale of the type, 1 in a contact sheet
    """
    room = SUPERSAMPLING * round(width / letters)
    lines: list[list[Image.Image]] = []
    for entry in (_reduced(_entry_picture(entry), room) for entry in entries):
        if not lines or sum(each.width for each in (*lines[-1], entry)) > room:
            lines.append([])
        lines[-1].append(entry)
    if not lines:
        return np.empty((0, width, 3), np.uint8)
    picture = Image.new("RGB", (room, SUPERSAMPLING * LINE * len(lines)), "white")
    for number, line in enumerate(lines):
        left = (room - sum(each.width for each in line)) // 2
        for entry in line:
            above = (SUPERSAMPLING * LINE - entry.height) // 2
            picture.paste(entry, (left, SUPERSAMPLING * LINE * number + above))
            left += entry.width
    return np.array(
        picture.resize((width, round(letters * LINE * len(lines))), Image.Resampling.LANCZOS)
    )


def _reduced(picture: Image.Image, width: int) -> Image.Image:
    """Return a picture reduced to at most a width [px]."""
    if picture.width <= width:
        return picture
    return picture.resize(
        (width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS
    )


def _entry_picture(entry: Entry) -> Image.Image:
    """Return the enlarged picture of a legend entry, with half a gap on either side."""
    fine = SUPERSAMPLING
    font = typeface(fine * TYPE_SIZE)
    middle, left, half = fine * LINE / 2, fine * GAP / 2, 8 * fine
    # a bar's last number needs room
    gap = (18 if entry.ticks else 8) * fine
    width = fine * WIDTHS[entry.kind]
    right = left + width
    picture = Image.new(
        "RGB", (round(right + gap + font.getlength(entry.text) + left), fine * LINE), "white"
    )
    draw = ImageDraw.Draw(picture)
    box = (left, middle - half, right, middle + half)
    if entry.kind == "bar":
        top, bottom = (fine * row for row in BAR)
        for pixel in range(round(left), round(right)):
            colour = tuple(SCALE_TABLE[int(255 * (pixel - left) / width)].tolist())
            draw.line((pixel, top, pixel, bottom), colour)
        row, size = (fine * number for number in NUMBER)
        for share, number in entry.ticks:
            at = left + share * width
            draw.line((at, fine * TICK[0], at, fine * TICK[1]), INK, fine)
            draw.text((at, row), number, INK, typeface(size), anchor="mm")
    elif entry.kind == "swatch":
        draw.rectangle(box, entry.colour)
    elif entry.kind == "glass":
        draw.rectangle(box, "#e3e9ed", GLASS_EDGE, fine)
    elif entry.kind == "arrow":
        draw.line((left, middle, right - half, middle), entry.colour, 2 * fine)
        draw.polygon(
            [(right, middle), (right - 2 * half, middle - half), (right - 2 * half, middle + half)],
            entry.colour,
        )
    draw.text((right + gap, middle), entry.text, INK, font, anchor="lm")
    return picture
