"""Colours of pictures: fixed colours, and fields on the surface in a colour scale."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_rgba_array
from matplotlib.ticker import MaxNLocator

from msmpetsc.backend.arrays import Array, Floats
from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.view.drawable import Drawable

FIXED, ARROW, INK = "#46566b", "#cf5a3c", "#333a42"
GROUND, SHADOW = "#efece6", "#cdc7bb"
GLASS, GLASS_EDGE = "#a3b6c4", "#667e90"
BOUNDARY_CELL, INTERIOR_CELL = "#c8372d", "#2f5fb3"  # Figure 2 of the paper: red and blue
# ColorBrewer's YlGnBu from a neutral grey, so that nothing at zero is tinted
SCALE = ("#dcdcdc", "#b9ddb9", "#7fcdbb", "#41b6c4", "#1d91c0", "#225ea8", "#253494", "#081d58")
CLASSES = (  # of bodies and of a body's parts
    "#8fabc6", "#e0a13a", "#5aa469", "#b56aa8", "#c9625a", "#6f7fc4", "#9c8b5e", "#4fa3a5", "#d98cb3", "#7d6b5d",
)  # fmt: skip
# red, green and blue (256, 3), 0 to 255: along the scale, and of classes over and over
ALONG_SCALE = LinearSegmentedColormap.from_list("", SCALE)(np.arange(256))[:, :3]
SCALE_TABLE: Array = np.rint(255 * ALONG_SCALE).astype(np.uint8)
CLASS_TABLE: Array = np.rint(255 * np.resize(to_rgba_array(CLASSES)[:, :3], (256, 3))).astype(
    np.uint8
)


# Fields on the surface

# A scale ends at most at BEYOND times the value that this share of the area stays below.
BELOW, BEYOND = 0.99, 1.25
ROUNDING = 1e-12  # share of a field's natural size; a smaller field is rounding error
PREFIXES = {1e9: "G", 1e6: "M", 1e3: "k", 1.0: "", 1e-3: "m", 1e-6: "µ", 1e-9: "n"}


@dataclass(frozen=True)
class Colouring:
    """A scalar field on the surface points, with its colour scale.

    title   : name of the field
    unit    : "m", "Pa", "%"; "" for numbers of classes
    values  : number of a frame -> (v,)
    high    : end of the scale, which begins at 0
    classes : names of the classes that the numbers mean; the legend has those that are not ""
    most    : greatest value, 0 if unknown; above `high` if the scale is clipped
    natural : size that the field takes if a body moves as far as it is large; 0 if there is none
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
        """Red, green and blue (256, 3) of the colours by their numbers, 0 to 255."""
        return CLASS_TABLE if self.classes else SCALE_TABLE

    def numbers(self, index: int) -> Array:
        """Return the numbers (v,) of a frame's colours; beyond an end of the scale it is that end's."""
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
        """Shares of the scale in [0, 1] at round numbers, with the numbers of the label's unit."""
        if self.high == 0:
            return ((0.0, "0"),)
        high = self.high / self._size
        numbers = MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(0, high)
        return tuple((number / high, f"{number:.3g}") for number in numbers if 0 <= number <= high)

    @property
    def _size(self) -> float:
        """One unit of the ticks, in the unit of the values."""
        return (
            0.01
            if self.unit == "%"
            else next((size for size in PREFIXES if self.high >= size), 1.0)
        )


def colouring_of(subject: Drawable, name: str | None) -> Colouring:
    """Return a field by name; that of the bodies' numbers for None. Raises InputError."""
    if name is None:
        number = subject.rest.body_of_point.astype(float)
        return Colouring("body", "", lambda _: number, classes=("",) * len(CLASSES))
    if name not in COLOURINGS:
        near = did_you_mean(name, COLOURINGS)
        raise InputError(
            f"--colour {name}: there is no such field, but {', '.join(COLOURINGS)}{near}"
        )
    return COLOURINGS[name](subject)


def _displacement(subject: Drawable) -> Colouring:
    """Return the field of distances from the points at rest."""
    rest = subject.rest.points
    return Colouring(
        "displacement",
        "m",
        lambda index: np.linalg.norm(subject.surface(index) - rest, axis=1),
        natural=abs(rest).max(),
    )


def _speed(subject: Drawable) -> Colouring:
    """Return the field of mean speeds between the frames before and after."""
    last = len(subject.times) - 1

    def values(index: int) -> Floats:
        before, after = max(index - 1, 0), min(index + 1, last)
        if before == after:
            return np.zeros(len(subject.rest.points))
        velocity = (subject.surface(after) - subject.surface(before)) / (
            subject.times[after] - subject.times[before]
        )
        return np.asarray(np.linalg.norm(velocity, axis=1))

    return Colouring(
        "speed",
        "m/s",
        values,
        natural=abs(subject.rest.points).max() / (np.ptp(subject.times) or 1.0),
    )


def _strain(subject: Drawable) -> Colouring:
    """Return the field of the springs' relative change of length, root mean square around a node."""
    springs, rest_length = subject.array("lattice/springs"), subject.array("lattice/rest_length")
    count = np.maximum(1, np.bincount(springs.ravel(), minlength=len(subject.rest.nodes)))

    def values(index: int) -> Floats:
        nodes = subject.nodes(index)
        length = np.linalg.norm(nodes[springs[:, 0]] - nodes[springs[:, 1]], axis=1)
        squares = np.repeat((length / rest_length - 1) ** 2, 2)
        return subject.on_surface(
            np.sqrt(np.bincount(springs.ravel(), squares, len(nodes)) / count)
        )

    return Colouring("strain of the springs", "%", values, natural=1.0)


def _stress(subject: Drawable) -> Colouring:
    """Return the field of von Mises' stress at the nodes, carried by the embedding."""
    von_mises = subject.von_mises
    if von_mises is None:
        if subject.scene.material.poisson is None:
            raise InputError(
                f"--colour stress: {subject.name} is of springs, whose law has no stress"
            )
        raise InputError(
            f"--colour stress: {subject.name} has no stress: run its scene with output.stress = true"
        )
    young = subject.scene.material.young_modulus or 0.0
    return Colouring(
        "von Mises' stress", "Pa", lambda index: subject.on_surface(von_mises(index)), natural=young
    )


def _part(subject: Drawable) -> Colouring:
    """Return the field of the scene's part to which the nearest cell belongs last."""
    rest, parts = subject.rest, list(subject.scene.tables("part"))
    if not parts:
        raise InputError(f"--colour part: the scene of {subject.name} has no part")
    number = np.zeros(len(rest.cells))
    for index, part in enumerate(parts):
        number[rest.find_cells(part)] = index + 1
    of_points = number[rest.cells_around(rest.points, rest.body_of_point)]
    return Colouring(
        "part", "", lambda _: of_points, 1.0, ("material", *(part.key for part in parts))
    )


COLOURINGS: dict[str, Callable[[Drawable], Colouring]] = {
    "displacement": _displacement,
    "speed": _speed,
    "strain": _strain,
    "stress": _stress,
    "part": _part,
}


def scaled(colouring: Colouring, subject: Drawable, frames: Iterable[int]) -> Colouring:
    """Return a field with a scale for these frames that few points do not stretch."""
    a, b, c = subject.rest.points[subject.triangles].swapaxes(0, 1)
    area = np.repeat(np.linalg.norm(np.cross(b - a, c - a), axis=1), 3)
    weight = np.bincount(subject.triangles.ravel(), area, len(subject.rest.points))
    high = most = 0.0
    for index in frames:
        values = np.nan_to_num(colouring.values(index))
        order = np.argsort(values)
        below = np.cumsum(weight[order])
        usual = float(values[order[np.searchsorted(below, BELOW * below[-1])]])
        most, high = max(most, float(values.max())), max(high, BEYOND * usual)
    if most <= ROUNDING * colouring.natural:
        return replace(colouring, high=0.0)
    return replace(colouring, high=min(most, high) or most, most=most)
