"""Elements of charts: colours and markers, axes in readable units, points with tooltips.

A chart is a Vega-Lite specification, which vl-convert renders as SVG and PNG without a browser.
"""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import vl_convert
from numpy.typing import ArrayLike
from pandas import DataFrame

from msmpetsc.results.disk import write_whole
from msmpetsc.study import formatting
from msmpetsc.study.table import records

INK, FAINT = "#2b2f36", "#8a8f98"
# Okabe and Ito's colours without yellow, faint on white; then Paul Tol's and a brown
COLORS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#333333", "#e69f00", "#56b4e9",
    "#882255", "#999933", "#332288", "#8c6239",
)  # fmt: skip
X = "M-1,-.6L-.6,-1L0,-.4L.6,-1L1,-.6L.4,0L1,.6L.6,1L0,.4L-.6,1L-1,.6L-.4,0Z"
STAR = "M0,-1.2L.35,-.4L1.15,-.37L.52,.15L.7,.97L0,.5L-.7,.97L-.52,.15L-1.15,-.37L-.35,-.4Z"
SHAPES = ("circle", "square", "triangle-up", "diamond", "triangle-down", "cross", X, STAR)
RING = "M1,0A1,1,0,1,1,-1,0A1,1,0,1,1,1,0M.86,0A.86,.86,0,1,0,-.86,0A.86,.86,0,1,0,.86,0"
# width of a chart and height of a panel [px]
WIDTH, HEIGHT = 1080, 280
CONFIG: dict[str, Any] = {
    "background": "white",
    "font": "DejaVu Sans, Verdana, Arial, sans-serif",
    "view": {"stroke": None},
    "axis": {"titleFontWeight": "normal", "labelFontSize": 12, "labelOverlap": "greedy"},
    "title": {"anchor": "start", "fontWeight": "normal"},
    "legend": {
        "orient": "bottom", "labelFontSize": 12, "labelLimit": WIDTH, "symbolOpacity": 1,
        "symbolStrokeWidth": 0,
    },
    "point": {"opacity": 1},
}  # fmt: skip
UNIT = "replace(format(datum.value, '~s'), regexp('([^0-9.]?)$'), '\N{NO-BREAK SPACE}$1{}')"
# formats of ticks, as Vega expressions
ERROR = "replace(format(datum.value, '~e'), '+', '')"
COUNT = "format(datum.value, '~s')"
SECONDS, BYTES = UNIT.format("s"), UNIT.format("B")


class CurveStyle(NamedTuple):
    """Colour and marker of a method."""

    color: str
    shape: str


# style of each label; names of the columns on the x axis and the y axis
Styles = dict[str, CurveStyle]
Columns = tuple[str, str]


def curve_styles(labels: Iterable[str]) -> Styles:
    """Return a style for each label, assigned in order of first appearance."""
    styles = map(CurveStyle, cycle(COLORS), cycle(SHAPES))
    return dict(zip(dict.fromkeys(labels), styles, strict=False))


def tips(rows: DataFrame, names: Iterable[str]) -> list[str]:
    """Return the tooltip of each row: its label, its numbers, and the command that repeats it."""
    names = list(dict.fromkeys(names))
    lines = (
        [row["label"], *(formatting.entry(row, name) for name in names), row["command"]]
        for row in records(rows)
    )
    return ["\n".join(filter(None, tip)) for tip in lines]


def channel(title: str, words: str, **scale: Any) -> dict[str, Any]:
    """Return an axis; the Vega expression ``words`` formats its tick labels."""
    return {
        "type": "quantitative",
        "title": title,
        "scale": {"nice": False, "zero": False} | scale,
        "axis": {"labelExpr": words},
    }


def log_axis(title: str, values: ArrayLike, words: str) -> dict[str, Any]:
    """Return a logarithmic axis for positive values, with a margin of a factor of 2 at both ends.

    NaN is ignored.
    """
    low, high = float(np.nanmin(values)) / 2, float(np.nanmax(values)) * 2
    made = channel(title, words, type="log", domain=[low, high])
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)))
    steps = (1, 2, 5) if len(decades) < 4 else (1,)
    made["axis"]["values"] = [step * 10.0**decade for decade in decades for step in steps]
    return made


@dataclass
class Axes:
    """A panel: two axes, layers drawn in it, and the styles of the chart's curves."""

    title: str
    x: dict[str, Any]
    y: dict[str, Any]
    styles: Styles
    layers: list[dict[str, Any]] = field(default_factory=list)

    def draw(self, values: list[dict[str, Any]], mark: dict[str, Any], **channels: Any) -> None:
        """Add a layer of values, each with x, y and the fields of the other channels."""
        if values:
            axes = {"x": {"field": "x"} | self.x, "y": {"field": "y"} | self.y}
            silent = {"aria": "description" in channels}
            self.layers.append(
                {"data": {"values": values}, "mark": mark | silent, "encoding": axes | channels}
            )

    def stair(self, x: Iterable[float], y: Iterable[float]) -> None:
        """Draw a grey step function through points by increasing x."""
        values = [{"x": a, "y": b} for a, b in zip(x, y, strict=True)]
        mark = {"type": "line", "color": FAINT, "interpolate": "step-after", "strokeWidth": 1.2}
        self.draw(values, mark)

    def whiskers(self, rows: DataFrame, columns: Columns) -> None:
        """Draw the range of each row over its repeats, by its columns from ``spread``."""
        ends = rows[[columns[0], "least", "greatest", "label"]].dropna()
        values = records(ends.set_axis(["x", "y", "high", "curve"], axis=1))
        part = {"opacity": 1, "aria": False}
        bar = {"type": "errorbar", "ticks": part | {"size": 7}, "rule": part}
        self.draw(values, bar, y2={"field": "high"}, color=nominal(self.styles, "color"))

    def line(self, values: list[dict[str, Any]], **mark: Any) -> None:
        """Draw a line through the values of each curve, in their order."""
        line = {"type": "line", "strokeWidth": 1.6} | mark
        self.draw(values, line, order={"value": None}, color=nominal(self.styles, "color"))

    def mark(self, values: list[dict[str, Any]]) -> None:
        """Draw a marker with a tooltip for each value from ``points``."""
        mark = {"type": "point", "size": 50, "stroke": "white", "strokeWidth": 0.6}
        shape, color = nominal(self.styles, "shape"), nominal(self.styles, "color")
        self.draw(values, mark, shape=shape, fill=color, description={"field": "tip"})

    def rings(self, rows: DataFrame, columns: Columns) -> None:
        """Draw a ring around each row."""
        values = [{"x": x, "y": y} for x, y in rows[list(columns)].itertuples(index=False)]
        mark = {"type": "point", "shape": RING, "size": 240, "fill": INK, "strokeWidth": 0}
        self.draw(values, mark)


def points(rows: DataFrame, columns: Columns, names: Iterable[str]) -> list[dict[str, Any]]:
    """Return each row as a point with coordinates, curve and tooltip."""
    values = rows[[*columns, "label"]].set_axis(["x", "y", "curve"], axis=1)
    return records(values.assign(tip=tips(rows, names)))


@dataclass
class Chart:
    """Panels with a common legend.

    name     : name of its PNG file without suffix
    kind     : heading that it shares with similar charts
    columns  : largest number of panels side by side
    gap      : distance between panels, which contains the axis labels [px]
    """

    name: str
    kind: str
    title: str
    caption: str
    styles: Styles
    columns: int = 3
    gap: float = 85
    height: float = HEIGHT
    panels: list[Axes] = field(default_factory=list)

    @property
    def anchor(self) -> str:
        """The id of the chart's element in the report."""
        return "chart-" + re.sub(r"\W|_", "-", self.name)

    def panel(self, title: str, x: dict[str, Any], y: dict[str, Any]) -> Axes:
        """Append a panel and return it."""
        self.panels.append(Axes(title, x, y, self.styles))
        return self.panels[-1]

    def spec(self) -> dict[str, Any]:
        """Return the Vega-Lite specification: rows of panels above a common legend."""
        columns = min(len(self.panels), self.columns)
        width = (WIDTH - self.gap * (columns - 1)) / columns
        panels = [
            {"title": panel.title, "width": width, "height": self.height, "layer": panel.layers}
            for panel in self.panels
        ]
        lines = [
            {"hconcat": panels[at : at + columns], "spacing": 15}
            for at in range(0, len(panels), columns)
        ]
        own_legend = {"scale": {"fill": "independent", "shape": "independent"}}
        return {"vconcat": [*lines, legend(self.styles)], "resolve": own_legend, "spacing": 14}


def legend(styles: Styles) -> dict[str, Any]:
    """Return a chart that shows only the legend."""
    # a letter is about 8 pixels wide
    longest = 8 * max(map(len, styles), default=1)
    shown = {"title": None, "columns": max(1, WIDTH // (longest + 40))}
    channels = {"fill": nominal(styles, "color", shown), "shape": nominal(styles, "shape", shown)}
    values = {"values": [{"curve": name} for name in styles]}
    mark = {"type": "point", "opacity": 0, "aria": False}
    return {"width": WIDTH, "height": 1, "data": values, "mark": mark, "encoding": channels}


def nominal(styles: Styles, name: str, legend: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return the channel that encodes a curve as its "color" or "shape"."""
    scale = {"domain": list(styles), "range": [getattr(style, name) for style in styles.values()]}
    return {"field": "curve", "type": "nominal", "scale": scale, "legend": legend}


def save_png(chart: Chart, folder: Path) -> None:
    """Write a chart with its title as a PNG file in a folder."""
    title = {"text": chart.title, "fontWeight": "bold", "fontSize": 15, "offset": 12}
    image = vl_convert.vegalite_to_png({"config": CONFIG, "title": title} | chart.spec(), scale=1.5)
    write_whole(folder / f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', chart.name)}.png", image)


def svg_text(chart: Chart) -> str:
    """Return a chart as an <svg> element; browsers show the <title> of a point as its tooltip."""
    text = vl_convert.vegalite_to_svg({"config": CONFIG} | chart.spec())
    point = re.compile(r'<path aria-label="([^"]*)"([^>]*)/>')
    return point.sub(r'<path class="point"\2><title>\1</title></path>', text)
