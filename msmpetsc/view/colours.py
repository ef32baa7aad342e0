"""Colours of pictures: fixed colours, and scalar fields on the surface in a colour scale."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_rgba_array
from matplotlib.ticker import MaxNLocator

from msmpetsc.backend.arrays import Array, Floats
from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.results.comparison import point_areas
from msmpetsc.view.drawable import Drawable

FIXED, ARROW, INK = "#46566b", "#cf5a3c", "#333a42"
GROUND, SHADOW = "#efece6", "#cdc7bb"
GLASS, GLASS_EDGE = "#a3b6c4", "#667e90"
# red and blue, as in the paper's Figure 2
BOUNDARY_CELL, INTERIOR_CELL = "#c8372d", "#2f5fb3"
# ColorBrewer's YlGnBu with a neutral grey at 0, so that zero looks uncoloured
SCALE = ("#dcdcdc", "#b9ddb9", "#7fcdbb", "#41b6c4", "#1d91c0", "#225ea8", "#253494", "#081d58")
# colours of bodies and of parts, used cyclically
CLASSES = (
    "#8fabc6", "#e0a13a", "#5aa469", "#b56aa8", "#c9625a", "#6f7fc4", "#9c8b5e", "#4fa3a5",
    "#d98cb3", "#7d6b5d",
)  # fmt: skip
# red, green and blue (256, 3) in 0 to 255, of the scale and of the classes
ALONG_SCALE = LinearSegmentedColormap.from_list("", SCALE)(np.arange(256))[:, :3]
SCALE_TABLE: Array = np.rint(255 * ALONG_SCALE).astype(np.uint8)
CLASS_TABLE: Array = np.rint(255 * np.resize(to_rgba_array(CLASSES)[:, :3], (256, 3))).astype(
    np.uint8
)


# ---- fields on the surface

# share of the area whose values lie below the value that sets the scale [-]; a few
# extreme points then do not stretch the scale
QUANTILE = 0.99
# largest ratio of the scale's upper end to that value [-]
HEADROOM = 1.25
# ratio to a field's natural size below which the field is rounding [-]
ROUNDING = 1e-12
PREFIXES = {1e9: "G", 1e6: "M", 1e3: "k", 1.0: "", 1e-3: "m", 1e-6: "µ", 1e-9: "n"}


@dataclass(frozen=True)
class Colouring:
    """A scalar field on the surface points, with its colour scale.

    title   : name of the field
    unit    : "m", "Pa", "%"; "" for class numbers
    values  : function from a frame's number to the values (v,)
    high    : upper end of the scale, which begins at 0
    classes : name of each class number; the legend omits a class named ""
    most    : greatest value, 0 if unknown; above ``high`` if values are clipped
    natural : size of the field if a body moves by its own length; 0 if unknown
    """

    title: str
    unit: str
    values: Callable[[int], Floats]
    high: float = 1.0
    classes: tuple[str, ...] = ()
    most: float = 0.0
    natural: float = 0.0

    @property
    def table(self) -> Array:
        """Red, green and blue (256, 3) in 0 to 255 of each colour number."""
        return CLASS_TABLE if self.classes else SCALE_TABLE

    def numbers(self, index: int) -> Array:
        """Return the colour numbers (v,) of a frame, clipped to the scale."""
        step = 1.0 if self.classes else (self.high or 1.0) / 255
        return np.clip(np.rint(np.nan_to_num(self.values(index) / step)), 0, 255).astype(np.uint8)

    @property
    def label(self) -> str:
        """Title with the unit of the ticks: "stress [kPa]", or "..., clipped at 80, most 210"."""
        prefix = "" if self.unit == "%" else PREFIXES.get(self._size, "")
        label = f"{self.title} [{prefix}{self.unit}]"
        high, most = (f"{float(f'{end / self._size:.3g}'):g}" for end in (self.high, self.most))
        return f"{label}, clipped at {high}, most {most}" if self.most > self.high else label

    @property
    def ticks(self) -> tuple[tuple[float, str], ...]:
        """Position on the scale in [0, 1] and number of each tick, in the unit of the label."""
        if self.high == 0:
            return ((0.0, "0"),)
        high = self.high / self._size
        numbers = MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(0, high)
        return tuple((number / high, f"{number:.3g}") for number in numbers if 0 <= number <= high)

    @property
    def _size(self) -> float:
        """Size of the ticks' unit in units of the values."""
        if self.unit == "%":
            return 0.01
        return next((size for size in PREFIXES if self.high >= size), 1.0)


def colouring_of(subject: Drawable, name: str | None) -> Colouring:
    """Return a field by its name, or the body numbers for None. Raises InputError."""
    if name is None:
        number = subject.rest.body_of_point.astype(float)
        return Colouring("body", "", lambda _: number, classes=("",) * len(CLASSES))
    if name not in COLOURINGS:
        near = did_you_mean(name, COLOURINGS)
        fields = ", ".join(COLOURINGS)
        raise InputError(f"--colour {name}: no such field; the fields are {fields}{near}")
    return COLOURINGS[name](subject)


def _displacement(subject: Drawable) -> Colouring:
    """Return the field of distances [m] of the points from their rest positions."""
    rest = subject.rest.points

    def values(index: int) -> Floats:
        return np.asarray(np.linalg.norm(subject.surface(index) - rest, axis=1))

    return Colouring("displacement", "m", values, natural=abs(rest).max())


def _speed(subject: Drawable) -> Colouring:
    """Return the field of mean speeds [m/s] between the previous and the next frame."""
    last = len(subject.times) - 1

    def values(index: int) -> Floats:
        before, after = max(index - 1, 0), min(index + 1, last)
        if before == after:
            return np.zeros(len(subject.rest.points))
        way = subject.surface(after) - subject.surface(before)
        duration = subject.times[after] - subject.times[before]
        return np.asarray(np.linalg.norm(way, axis=1) / duration)

    natural = abs(subject.rest.points).max() / (np.ptp(subject.times) or 1.0)
    return Colouring("speed", "m/s", values, natural=natural)


def _strain(subject: Drawable) -> Colouring:
    """Return the field of spring strains: rms of the springs at each node, interpolated."""
    springs = subject.array("lattice/springs")
    rest_length = subject.array("lattice/rest_length")
    count = np.maximum(1, np.bincount(springs.ravel(), minlength=len(subject.rest.nodes)))

    def values(index: int) -> Floats:
        nodes = subject.nodes(index)
        length = np.linalg.norm(nodes[springs[:, 0]] - nodes[springs[:, 1]], axis=1)
        squares = np.repeat((length / rest_length - 1) ** 2, 2)
        sums = np.bincount(springs.ravel(), squares, len(nodes))
        return subject.on_surface(np.sqrt(sums / count))

    return Colouring("strain of the springs", "%", values, natural=1.0)


def _stress(subject: Drawable) -> Colouring:
    """Return the field of von Mises stresses [Pa] of the nodes, interpolated to the surface."""
    von_mises = subject.von_mises
    if von_mises is None:
        why = "stores no stress: run its scene with output.stress = true"
        if subject.scene.material.poisson is None:
            why = "is of springs, whose law has no stress"
        raise InputError(f"--colour stress: {subject.name} {why}")
    young = subject.scene.material.young_modulus or 0.0
    return Colouring(
        "von Mises' stress", "Pa", lambda index: subject.on_surface(von_mises(index)), natural=young
    )


def _part(subject: Drawable) -> Colouring:
    """Return the field of part numbers; a point belongs to the last part that contains it."""
    rest = subject.rest
    parts = list(subject.scene.tables("part"))
    if not parts:
        raise InputError(f"--colour part: the scene of {subject.name} has no part")
    number = np.zeros(len(rest.points))
    for index, part in enumerate(parts):
        number[rest.points_in(part)] = index + 1
    return Colouring("part", "", lambda _: number, 1.0, ("material", *(part.key for part in parts)))


COLOURINGS: dict[str, Callable[[Drawable], Colouring]] = {
    "displacement": _displacement, "speed": _speed, "strain": _strain, "stress": _stress,
    "part": _part,
}  # fmt: skip


def scaled(colouring: Colouring, subject: Drawable, frames: Iterable[int]) -> Colouring:
    """Return a field with its scale for some frames; a few extreme points do not stretch it."""
    weight = point_areas(subject.rest.points, subject.triangles)
    high = most = 0.0
    for index in frames:
        values = np.nan_to_num(colouring.values(index))
        order = np.argsort(values)
        below = np.cumsum(weight[order])
        usual = float(values[order[np.searchsorted(below, QUANTILE * below[-1])]])
        most = max(most, float(values.max()))
        high = max(high, HEADROOM * usual)
    if most <= ROUNDING * colouring.natural:
        return replace(colouring, high=0.0)
    return replace(colouring, high=min(most, high) or most, most=most)
