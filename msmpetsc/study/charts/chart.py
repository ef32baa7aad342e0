"""A chart: a figure, the numbers of every point in it, and what it says in plain words."""

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from msmpetsc.study.charts.style import Look
from msmpetsc.study.rows import Row
from msmpetsc.study.spread import Cost, spread

WIDTH = 12.2  # [in], 72 points each: 1171 pixels of the page
PANEL = 4.3  # [in]: height of the axes with their labels
LEGEND_ROW = 0.235  # [in]
EDGE = {"markeredgecolor": "white", "markeredgewidth": 0.6}
LABEL_WIDTH = 62  # [characters]: a longer label goes on in a second line


@dataclass(frozen=True)
class Point:
    """One measured point: its curve, its numbers by heading with how to word them, and the command that repeats it."""

    label: str
    numbers: dict[str, tuple[Callable[[float | None], str], float | None]]
    command: str

    def texts(self) -> dict[str, str]:
        """The numbers in words; empty where there is none."""
        return {name: word(value) for name, (word, value) in self.numbers.items()}

    def __str__(self) -> str:
        lines = [self.label, *(f"{name}: {text}" for name, text in self.texts().items() if text), self.command]
        return "\n".join(filter(None, lines))


@dataclass
class Chart:
    """name: of its file; kind: the heading it stands under; points: by panel, then by the id of
    the group of marks in the SVG that stands for them, in its order;
    findings: lines in plain words by their heading; cheapest: by kind of error, for each level of it the row that wins
    and those within its noise."""

    name: str
    kind: str
    title: str
    caption: str
    figure: Figure
    points: dict[str, dict[str, list[Point]]] = field(default_factory=dict)
    findings: dict[str, list[str]] = field(default_factory=dict)
    failed: list[Row] = field(default_factory=list)
    cheapest: dict[str, list[list[Row]]] = field(default_factory=dict)

    def mark(self, axes: Axes, x: list[float], y: list[float], points: list[Point], look: Look, **style) -> None:
        """Draws measured points; panels are told apart by their titles."""
        if not points:
            return
        panel = self.points.setdefault(axes.get_title(loc="left"), {})
        group = f"{self.name}-{sum(map(len, self.points.values()))}"
        panel[group] = points
        shape = {"marker": look.marker, "markersize": look.size, "markerfacecolor": look.color} | EDGE | style
        axes.plot(x, y, linestyle="none", zorder=4, clip_on=False, gid=group, **shape)

    def whiskers(self, axes: Axes, x: list[float], rows: list[Row], cost: Cost, look: Look) -> None:
        """From the least to the greatest of the repeats of each row, where it was repeated."""
        spreads = [(at, *spread(row, cost)) for at, row in zip(x, rows) if spread(row, cost)]
        if spreads:
            at, low, high = zip(*spreads)
            axes.vlines(at, low, high, color=look.color, linewidth=1.1, zorder=3.5)
            axes.plot([*at, *at], [*low, *high], "_", color=look.color, markersize=7, zorder=3.5)


def new_figure(panels: int, legend: Sequence[str]) -> tuple[Figure, Sequence[Axes]]:
    """A row of panels with room below for a legend of these labels."""
    rows, _ = legend_shape(legend)
    figure = Figure(figsize=(WIDTH, PANEL + 0.35 + rows * LEGEND_ROW), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.12, h_pad=0.06, wspace=0.02)
    return figure, figure.subplots(1, panels, squeeze=False)[0]


def legend_shape(labels: Sequence[str]) -> tuple[int, int]:
    """Lines and columns of a legend as wide as the figure."""
    wrapped = [wrap(label) for label in labels]
    longest = max((len(line) for lines in wrapped for line in lines), default=1)
    fit = max(1, min(6, len(labels), int(WIDTH / (0.088 * longest + 0.65))))
    lines = -(-len(labels) // fit)
    return lines * max(map(len, wrapped), default=1), -(-len(labels) // lines)  # as even as can be


def wrap(label: str) -> list[str]:
    return textwrap.wrap(label, LABEL_WIDTH, break_on_hyphens=False) or [""]


def legend_below(figure: Figure, handles: dict[str, Line2D]) -> None:
    """One legend for all panels, outside the axes."""
    _, columns = legend_shape(list(handles))
    labels = ["\n".join(wrap(label)) for label in handles]
    figure.legend(handles.values(), labels, loc="outside lower center", ncols=columns, handlelength=2.2)


def handle(look: Look, line: str = "-") -> Line2D:
    """What stands for a curve in a legend."""
    return Line2D([], [], color=look.color, marker=look.marker, linestyle=line, markersize=look.size, **EDGE)


def repeats(row: Row, cost: Cost, word: Callable[[float | None], str]) -> dict:
    """Numbers of a Point: the range of the repeats, empty where it is not known."""
    low, high = spread(row, cost) or (None, None)
    return {"least of the repeats": (word, low), "greatest of the repeats": (word, high)}
