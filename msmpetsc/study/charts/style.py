"""What all charts share: a colour and a marker for each method, readable axes, and points that tell their numbers.

A chart draws rows of a table: ``Chart.curve`` takes the columns of both axes, and a dict of ``Numbers`` that says what
each point tells of itself.
"""

import io
import math
import re
import textwrap
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import cycle, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, Formatter, FuncFormatter, LogLocator, NullFormatter
from numpy.typing import ArrayLike

from msmpetsc.output.disk import whole_file
from msmpetsc.study import formatting
from msmpetsc.study.table import Row, records, spread

if TYPE_CHECKING:
    from pandas import DataFrame

INK, FAINT, GRID = "#2b2f36", "#8a8f98", "#e4e6ea"
# Okabe and Ito's colours without their yellow, which white paper swallows, then Tol's wine, olive, indigo, and a brown.
COLORS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#333333", "#e69f00", "#56b4e9",
    "#882255", "#999933", "#332288", "#8c6239",
)  # fmt: skip
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", "p", "*", ">", "h")  # twelve and eleven: a pair is back after 132
WIDER = {"P": 9, "X": 9, "*": 11, "^": 8, "v": 8, "<": 8, ">": 8, "p": 8, "D": 6.5}  # [points]: markers of like weight

WIDTH = 12.2  # [in], 72 points each: 1171 pixels of the page
PANEL = 4.3  # [in]: height of the axes with their labels
LEGEND_ROW = 0.235  # [in]
EDGE: dict[str, Any] = {"markeredgecolor": "white", "markeredgewidth": 0.6}
LABEL_WIDTH = 62  # [characters]: a longer label goes on in a second line

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
SVG = "http://www.w3.org/2000/svg"
ElementTree.register_namespace("", SVG)
ElementTree.register_namespace("xlink", "http://www.w3.org/1999/xlink")

Numbers = dict[str, tuple[Callable[[Any], str], str]]  # by heading: how to word a number, and its column
REPEATS: Numbers = {
    "least of the repeats": (formatting.seconds, "time_frame_min"),
    "greatest of the repeats": (formatting.seconds, "time_frame_max"),
}


@dataclass(frozen=True)
class CurveStyle:
    """Colour and marker of one method, the same in all charts."""

    color: str
    marker: str

    @property
    def size(self) -> float:
        """Width of the marker [points]."""
        return WIDER.get(self.marker, 7)

    def handle(self, line: Any = "-") -> Line2D:
        """Return what stands for a curve in a legend."""
        return Line2D([], [], color=self.color, marker=self.marker, linestyle=line, markersize=self.size, **EDGE)


Styles = dict[str, CurveStyle]  # by label


def curve_styles(labels: Iterable[str]) -> Styles:
    """Return one style a label, given out in order of first appearance."""
    labels = list(dict.fromkeys(labels))
    pairs = islice(zip(cycle(COLORS), cycle(MARKERS), strict=False), len(labels))
    return {label: CurveStyle(*pair) for label, pair in zip(labels, pairs, strict=True)}


@dataclass(frozen=True)
class Point:
    """One measured point: its curve, its numbers by heading with how to word them, and the command that repeats it."""

    label: str
    numbers: dict[str, tuple[Callable[[Any], str], Any]]
    command: str

    def texts(self) -> dict[str, str]:
        """Return the numbers in words; empty where there is none."""
        return {name: word(value) for name, (word, value) in self.numbers.items()}

    def __str__(self) -> str:
        lines = [self.label, *(f"{name}: {text}" for name, text in self.texts().items() if text), self.command]
        return "\n".join(filter(None, lines))


def points_of(rows: "DataFrame", numbers: Numbers, label: str = "label") -> list[Point]:
    """Return a point for each row; ``label`` is the column with the name of its curve."""
    return [
        Point(row[label], {name: (word, row[column]) for name, (word, column) in numbers.items()}, row["command"])
        for row in records(rows)
    ]


@dataclass
class Chart:
    """A figure, the numbers of every point in it, and what it says in plain words.

    name     : of its file
    kind     : the heading it stands under
    points   : by panel, then by the id of the group in the SVG that draws them, in its order
    findings : lines in plain words, by their heading
    failed   : rows of cases that are missing from it
    cheapest : by kind of error, for each level of it the row that wins and those within its noise
    """

    name: str
    kind: str
    title: str
    caption: str
    figure: Figure
    points: dict[str, dict[str, list[Point]]] = field(default_factory=dict)
    findings: dict[str, list[str]] = field(default_factory=dict)
    failed: list[Row] = field(default_factory=list)
    cheapest: dict[str, list[list[Row]]] = field(default_factory=dict)

    def curve(
        self,
        axes: Axes,
        rows: "DataFrame",
        columns: tuple[str, str],
        style: CurveStyle,
        *,
        numbers: Numbers,
        label: str = "label",
        line: str = "-",
        whiskers: bool = False,
        linewidth: float | None = None,
        **marker: Any,
    ) -> None:
        """Draw rows as a line with a marker at each point.

        columns  : of both axes
        label    : column with the name of the curve
        whiskers : from the least to the greatest of the repeats
        """
        axes.plot(*(rows[name] for name in columns), line, color=style.color, linewidth=linewidth)
        if whiskers:
            self.whiskers(axes, rows, columns, style)
        self.mark(axes, rows, columns, style, numbers=numbers, label=label, **marker)

    def mark(
        self,
        axes: Axes,
        rows: "DataFrame",
        columns: tuple[str, str],
        style: CurveStyle,
        *,
        numbers: Numbers,
        label: str = "label",
        **marker: Any,
    ) -> None:
        """Draw a marker at each row; panels are told apart by their titles."""
        if not len(rows):
            return
        panel = self.points.setdefault(axes.get_title(loc="left"), {})
        group = f"{self.name}-{sum(map(len, self.points.values()))}"
        panel[group] = points_of(rows, numbers, label)
        shape: dict[str, Any] = (
            {"marker": style.marker, "markersize": style.size, "markerfacecolor": style.color} | EDGE | marker
        )
        x, y = (rows[name] for name in columns)
        axes.plot(x, y, linestyle="none", zorder=4, clip_on=False, gid=group, **shape)

    def whiskers(self, axes: Axes, rows: "DataFrame", columns: tuple[str, str], style: CurveStyle) -> None:
        """Draw the spread of the repeats of each row that was repeated."""
        x, cost = columns
        ends = spread(rows, cost).dropna()
        if len(ends):
            at = rows.loc[ends.index, x]
            axes.vlines(at, ends["least"], ends["greatest"], color=style.color, linewidth=1.1, zorder=3.5)
            heights = [*ends["least"], *ends["greatest"]]
            axes.plot([*at, *at], heights, "_", color=style.color, markersize=7, zorder=3.5)


# Figures, legends and axes


def new_figure(panels: int, legend: Sequence[str]) -> tuple[Figure, Sequence[Axes]]:
    """Return a row of panels with room below for a legend of these labels."""
    rows, _ = legend_shape(legend)
    figure = Figure(figsize=(WIDTH, PANEL + 0.35 + rows * LEGEND_ROW), layout="constrained")
    set_padding(figure, w_pad=0.12, h_pad=0.06, wspace=0.02)
    return figure, figure.subplots(1, panels, squeeze=False)[0]


def set_padding(figure: Figure, **padding: float) -> None:
    """Set the space between the panels of a figure with constrained layout."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.set(**padding)


def title_axes(axes: Axes, title: str, x_label: str, y_label: str) -> None:
    """Say what a panel shows, over what."""
    axes.set_title(title, loc="left")
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)


def legend_shape(labels: Sequence[str]) -> tuple[int, int]:
    """Return lines and columns of a legend as wide as the figure."""
    wrapped = [wrap(label) for label in labels]
    longest = max((len(line) for lines in wrapped for line in lines), default=1)
    fit = max(1, min(6, len(labels), int(WIDTH / (0.088 * longest + 0.65))))
    lines = -(-len(labels) // fit)
    return lines * max(map(len, wrapped), default=1), -(-len(labels) // lines)  # as even as can be


def wrap(label: str) -> list[str]:
    """Return the lines of a long label."""
    return textwrap.wrap(label, LABEL_WIDTH, break_on_hyphens=False) or [""]


def legend_below(figure: Figure, handles: dict[str, Line2D]) -> None:
    """Add one legend for all panels, outside the axes."""
    _, columns = legend_shape(list(handles))
    labels = ["\n".join(wrap(label)) for label in handles]
    figure.legend(list(handles.values()), labels, loc="outside lower center", ncols=columns, handlelength=2.2)


def short(value: float) -> str:
    """Return 2, 2k, 2M; below 1 the number as it is."""
    return EngFormatter("", sep="")(value) if abs(value) >= 1 else f"{value:g}"


ERROR = FuncFormatter(lambda value, _position: formatting.error(value))
SECONDS = FuncFormatter(lambda value, _position: formatting.seconds(value))
COUNT = FuncFormatter(lambda value, _position: short(value))
BYTES = EngFormatter("B")


def log_axes(axes: Axes, x: ArrayLike, y: ArrayLike, formats: tuple[Formatter, Formatter]) -> None:
    """Make axes logarithmic around all values, each at least a decade long: three ticks at least have numbers."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(around(x))
    axes.set_ylim(around(y))
    log_ticks(axes.xaxis, around(x), formats[0], dense=2.5 if len(axes.figure.axes) < 3 else 1.6)
    log_ticks(axes.yaxis, around(y), formats[1])


def around(values: ArrayLike, margin: float = 0.08) -> tuple[float, float]:
    """Return limits around positive values: a margin on both sides, and a decade at least."""
    low, high = math.log10(np.min(values)), math.log10(np.max(values))
    length = max(high - low, 0.85)
    middle, half = (low + high) / 2, length * (0.5 + margin)
    return 10 ** (middle - half), 10 ** (middle + half)


def log_ticks(axis: Axis, limits: tuple[float, float], formatter: Formatter, dense: float = 2.5) -> None:
    """Put numbers at the decades, and at 2 and 5 where there are fewer decades than ``dense``."""
    decades = math.log10(limits[1] / limits[0])
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if decades < dense else (1,), numticks=12))
    axis.set_minor_locator(LogLocator(subs=range(2, 10), numticks=50))
    axis.set_minor_formatter(NullFormatter())
    axis.set_major_formatter(formatter)


# Files


def save_png(chart: Chart, folder: Path) -> Path:
    """Write the chart with its title, in a file of its name."""
    path = folder / f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', chart.name)}.png"
    with matplotlib.style.context(["default", RC]):
        chart.figure.suptitle(chart.title, x=0.01, ha="left", weight="bold")
        with whole_file(path) as part:
            chart.figure.savefig(part)
        chart.figure.suptitle("")
    return path


def svg_text(chart: Chart) -> str:
    """Return the chart as an <svg> element: every point has a <title>, which browsers show under the mouse."""
    stream = io.BytesIO()
    own_ids = {"svg.hashsalt": chart.name}  # that do not meet those of other charts in one page
    with matplotlib.style.context(["default", RC | own_ids]):
        chart.figure.savefig(stream, format="svg", transparent=True)
    root = ElementTree.fromstring(stream.getvalue())
    for metadata in root.findall(f"{{{SVG}}}metadata"):
        root.remove(metadata)
    for name in ("width", "height"):
        del root.attrib[name]
    root.set("role", "img")
    root.set("aria-label", chart.title)
    _add_titles(root, chart)
    return ElementTree.tostring(root, encoding="unicode")


def _add_titles(root: ElementTree.Element, chart: Chart) -> None:
    """Put the numbers of each point into what draws it; ids, which a page may hold but once, go."""
    groups = {group.attrib.pop("id", None): group for group in root.iter(f"{{{SVG}}}g")}
    for panel in chart.points.values():
        for name, points in panel.items():
            for use, point in zip(groups[name].iter(f"{{{SVG}}}use"), points, strict=True):
                use.set("class", "point")
                ElementTree.SubElement(use, f"{{{SVG}}}title").text = str(point)
