"""How a picture, a film or a page is to look: what ``msmpetsc render`` is asked for, beside frames and files."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Style:
    """Options of what is drawn.

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
