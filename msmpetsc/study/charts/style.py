"""How all charts look: a colour and a mark for each method, the same everywhere, and axes that can be read."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import cycle, islice

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, NullFormatter

from msmpetsc.study import formatting

INK, FAINT, GRID = "#2b2f36", "#8a8f98", "#e4e6ea"
# Okabe and Ito's colours without their yellow, which white paper swallows, then Tol's wine, olive, indigo, and a brown.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#333333", "#e69f00", "#56b4e9") + (
    "#882255", "#999933", "#332288", "#8c6239",
)  # fmt: skip
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", "p", "*", ">", "h")  # twelve and eleven: a pair is back after 132
WIDER = {"P": 9, "X": 9, "*": 11, "^": 8, "v": 8, "<": 8, ">": 8, "p": 8, "D": 6.5}  # [points]: marks of like weight

RC = {  # on matplotlib's own defaults
    "font.family": ["sans-serif"],
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial"],  # the first is matplotlib's own
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "svg.fonttype": "none",  # text stays text: it can be searched, and the page stays small
    "figure.dpi": 72,  # one point of the SVG is one point of the page
    "savefig.dpi": 150,
}


@dataclass(frozen=True)
class Look:
    """Colour and mark of one method."""

    color: str
    marker: str

    @property
    def size(self) -> float:
        """Width of the mark [points]."""
        return WIDER.get(self.marker, 7)


def looks(labels: Iterable[str]) -> dict[str, Look]:
    """One look a label, given out in order of first appearance."""
    labels = list(dict.fromkeys(labels))
    pairs = islice(zip(cycle(COLORS), cycle(MARKERS)), len(labels))
    return {label: Look(*pair) for label, pair in zip(labels, pairs)}


def short(value: float) -> str:
    """2, 2k, 2M; below 1 as it is."""
    return EngFormatter("", sep="")(value) if abs(value) >= 1 else f"{value:g}"


ERROR = FuncFormatter(lambda value, _position: formatting.error(value))
SECONDS = FuncFormatter(lambda value, _position: formatting.seconds(value))
COUNT = FuncFormatter(lambda value, _position: short(value))
BYTES = EngFormatter("B")


def log_axes(axes: Axes, x: Sequence[float], y: Sequence[float], x_format, y_format) -> None:
    """Logarithmic axes around all values, each at least a decade long, so that at least three ticks have numbers."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(around(x))
    axes.set_ylim(around(y))
    log_ticks(axes.xaxis, around(x), x_format, dense=2.5 if len(axes.figure.axes) < 3 else 1.6)
    log_ticks(axes.yaxis, around(y), y_format)


def around(values: Sequence[float], margin: float = 0.08) -> tuple[float, float]:
    """Limits around positive values: a margin on both sides, and a decade at least."""
    low, high = math.log10(min(values)), math.log10(max(values))
    reach = max(high - low, 0.85)
    middle, half = (low + high) / 2, reach * (0.5 + margin)
    return 10 ** (middle - half), 10 ** (middle + half)


def log_ticks(axis: Axis, limits: tuple[float, float], formatter, dense: float = 2.5) -> None:
    """Numbers at the decades, and at 2 and 5 where there are fewer decades than ``dense``."""
    decades = math.log10(limits[1] / limits[0])
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if decades < dense else (1,), numticks=12))
    axis.set_minor_locator(LogLocator(subs=range(2, 10), numticks=50))
    axis.set_minor_formatter(NullFormatter())
    axis.set_major_formatter(formatter)
