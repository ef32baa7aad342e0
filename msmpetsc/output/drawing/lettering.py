"""What is written in pictures, all in one typeface: captions, labels, legends."""

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from msmpetsc.output.drawing.colours import INK

if TYPE_CHECKING:  # a page has none
    from PIL.ImageFont import FreeTypeFont

CAPTION, LINES = 68, ((21, 22), (16, 50))  # [px]: height of a caption; of its lines, size and middle
LABEL = 11  # [px]


@cache
def font(size: int) -> "FreeTypeFont":
    """Return DejaVu Sans, which comes with matplotlib, in a size [px]."""
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")), size)


def caption_picture(caption: tuple[str, str], width: int, letters: float = 1.0) -> np.ndarray:
    """Return a caption's two lines (height, width, 3), in the middle; letters: their size, 1 in a sheet."""
    from PIL import Image, ImageDraw

    picture = Image.new("RGB", (width, round(letters * CAPTION)), "white")
    for text, (size, middle) in zip(caption, LINES, strict=True):
        at = width / 2, letters * middle
        ImageDraw.Draw(picture).text(at, text, INK, font(round(letters * size)), anchor="mm")
    return np.array(picture)


def labelled(picture: np.ndarray, labels: list[tuple[str, np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return a picture (height, width, 3) with labels: texts, where they begin (2,) [px from the top left], and the
    ways (2,) that lead from there out of what is labelled."""
    from PIL import Image, ImageDraw

    drawn = Image.fromarray(picture)
    for text, at, way in labels:
        half = np.array([font(LABEL).getlength(text), LABEL]) / 2
        middle = np.clip(at + half * way, half, np.array(drawn.size) - half)
        ImageDraw.Draw(drawn).text(tuple(middle), text, INK, font(LABEL), anchor="mm")
    return np.array(drawn)


def rounded(low: float, high: float) -> tuple[str, str]:
    """Return the ends of a span as they are written: to a thousandth of it or finer, 0 in place of -1e-5."""
    span = max(high - low, abs(high) * 1e-12, 1e-300)
    digits = 2 - int(np.floor(np.log10(span)))
    first, last = (f"{round(end, digits) + 0.0:.{max(digits, 0)}f}" for end in (low, high))
    return (_bare(first), _bare(last)) if digits > 0 else (first, last)


def _bare(number: str) -> str:
    return number.rstrip("0").rstrip(".")
