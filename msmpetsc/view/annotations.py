"""Text in pictures: captions and the legend, in a common typeface."""

from collections.abc import Sequence
from dataclasses import dataclass
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


def typeface(size: int) -> ImageFont.FreeTypeFont:
    """Return the font DejaVu Sans, which comes with matplotlib, in a size [px]."""
    return ImageFont.truetype(
        str(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")), size
    )


def caption_picture(caption: tuple[str, str], width: int) -> Array:
    """Return the picture (CAPTION, width, 3) of two centred lines."""
    picture = Image.new("RGB", (width, CAPTION), "white")
    for text, (size, middle) in zip(caption, LINES, strict=True):
        at = width / 2, middle
        ImageDraw.Draw(picture).text(at, text, INK, typeface(size), anchor="mm")
    return np.array(picture)


# a legend's line height, gap between entries, and type size [px]
LINE, GAP, TYPE_SIZE = 34, 36, 15
# width of the symbol in front of an entry's text [px]
WIDTHS = {"bar": 220, "swatch": 22, "glass": 22, "arrow": 22}
# first and last row of a bar and of a tick; middle and type size of its number [px]
BAR, TICK, NUMBER = (5, 17), (14, 20), (27, 12)


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


def legend_picture(entries: Sequence[Entry], width: int) -> Array:
    """Return the picture (height, width, 3) of legend entries, wrapped into lines."""
    lines: list[list[Image.Image]] = []
    for entry in map(_entry_picture, entries):
        # an entry wider than the legend shrinks
        entry.thumbnail((width, LINE), Image.Resampling.LANCZOS)
        if not lines or sum(each.width for each in (*lines[-1], entry)) > width:
            lines.append([])
        lines[-1].append(entry)
    picture = Image.new("RGB", (width, LINE * len(lines)), "white")
    for number, line in enumerate(lines):
        left = (width - sum(each.width for each in line)) // 2
        for entry in line:
            picture.paste(entry, (left, LINE * number + (LINE - entry.height) // 2))
            left += entry.width
    return np.array(picture)


def _entry_picture(entry: Entry) -> Image.Image:
    """Return the picture of a legend entry, with half a gap on either side."""
    font = typeface(TYPE_SIZE)
    left, middle = GAP // 2, LINE // 2
    right = left + WIDTHS[entry.kind]
    # a bar's last number needs room
    text = right + (18 if entry.ticks else 8)
    width = round(text + font.getlength(entry.text) + left)
    picture = Image.new("RGB", (width, LINE), "white")
    draw = ImageDraw.Draw(picture)
    box = (left, middle - 8, right, middle + 8)
    if entry.kind == "bar":
        top, bottom = BAR
        bar = Image.fromarray(SCALE_TABLE[None]).resize((WIDTHS["bar"], bottom - top))
        picture.paste(bar, (left, top))
        row, size = NUMBER
        for share, number in entry.ticks:
            at = left + share * WIDTHS["bar"]
            draw.line((at, TICK[0], at, TICK[1]), INK)
            draw.text((at, row), number, INK, typeface(size), anchor="mm")
    elif entry.kind == "swatch":
        draw.rectangle(box, entry.colour)
    elif entry.kind == "glass":
        draw.rectangle(box, "#e3e9ed", GLASS_EDGE)
    elif entry.kind == "arrow":
        draw.text(
            (left, middle), "\N{BLACK RIGHTWARDS ARROW}", entry.colour, typeface(24), anchor="lm"
        )
    draw.text((text, middle), entry.text, INK, font, anchor="lm")
    return picture
