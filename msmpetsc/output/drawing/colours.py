"""The colours of pictures, films and pages, and the scale that a field of numbers is shown in."""

import numpy as np

BODY, FIXED, ARROW, INK = "#8fabc6", "#46566b", "#cf5a3c", "#333a42"
GROUND, SHADOW = "#efece6", "#cdc7bb"
GLASS, GLASS_EDGE, BOX = "#a3b6c4", "#667e90", "#8a929b"
BOUNDARY_CELL, INTERIOR_CELL, SPRING = "#c8372d", "#2f5fb3", "#5b6570"  # Figure 2 of the paper: red and blue
# ColorBrewer's YlGnBu without its palest: the least is light, for dark is what is pinned
SCALE = ("#edf8b1", "#c7e9b4", "#7fcdbb", "#41b6c4", "#1d91c0", "#225ea8", "#253494", "#081d58")
CLASSES = (
    BODY,
    "#e0a13a",
    "#5aa469",
    "#b56aa8",
    "#c9625a",
    "#6f7fc4",
    "#9c8b5e",
    "#4fa3a5",
    "#d98cb3",
    "#7d6b5d",
)  # a body's parts, over and over


def rgb(colour: str) -> np.ndarray:
    """Return red, green and blue (3,) of "#8fabc6", 0 to 255."""
    return np.array([int(colour[digit : digit + 2], 16) for digit in (1, 3, 5)], float)


def on_scale(shares: np.ndarray) -> np.ndarray:
    """Return the colours (n, 3), 0 to 255, of shares (n,) of the scale's end; what is beyond it has that of the end."""
    stops = np.array([rgb(colour) for colour in SCALE])
    at = np.linspace(0, 1, len(stops))
    return np.stack([np.interp(np.nan_to_num(shares), at, channel) for channel in stops.T], axis=1)


def of_classes(numbers: np.ndarray) -> np.ndarray:
    """Return the colours (n, 3), 0 to 255, of the numbers (n,) of classes."""
    return np.array([rgb(colour) for colour in CLASSES])[numbers.astype(int) % len(CLASSES)]
