"""A chart as a PNG file, and as an SVG element whose points tell their numbers."""

import io
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from matplotlib import style

from msmpetsc.study.charts.chart import Chart
from msmpetsc.study.charts.style import RC

SVG = "http://www.w3.org/2000/svg"
ElementTree.register_namespace("", SVG)
ElementTree.register_namespace("xlink", "http://www.w3.org/1999/xlink")


def save_png(chart: Chart, folder: Path) -> Path:
    """The chart with its title, in a file of its name."""
    path = folder / f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', chart.name)}.png"
    with style.context(["default", RC]):
        chart.figure.suptitle(chart.title, x=0.01, ha="left", weight="bold")
        chart.figure.savefig(path)
        chart.figure.suptitle("")
    return path


def svg_text(chart: Chart) -> str:
    """The chart as an <svg> element: every point has a <title>, which browsers show where the mouse is."""
    stream = io.BytesIO()
    own_ids = {"svg.hashsalt": chart.name}  # that do not meet those of other charts in one page
    with style.context(["default", RC | own_ids]):
        chart.figure.savefig(stream, format="svg", transparent=True)
    root = ElementTree.fromstring(stream.getvalue())
    root.remove(root.find(f"{{{SVG}}}metadata"))
    for name in ("width", "height"):
        del root.attrib[name]
    root.set("role", "img")
    root.set("aria-label", chart.title)
    add_titles(root, chart)
    return ElementTree.tostring(root, encoding="unicode")


def add_titles(root: ElementTree.Element, chart: Chart) -> None:
    """Puts the numbers of each point into the mark that draws it; ids, which a page may hold but once, go."""
    groups = {group.attrib.pop("id", None): group for group in root.iter(f"{{{SVG}}}g")}
    for points in chart.points.values():
        for name, of_group in points.items():
            for mark, point in zip(groups[name].iter(f"{{{SVG}}}use"), of_group, strict=True):
                mark.set("class", "point")
                ElementTree.SubElement(mark, f"{{{SVG}}}title").text = str(point)
