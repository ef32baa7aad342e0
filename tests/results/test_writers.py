"""Every writer on a full disk says so in a line and leaves no incomplete file.

A limit on the size of files stands for the full disk. The system reports both alike, and the limit
needs no rights.
"""

import re
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import small_result
from ball_result import write_ball
from conftest import ROOT
from one_process import input_error

from msmpetsc.app.checks import MOVIE_NAMES, PAGE_NAMES, PICTURE_NAMES
from msmpetsc.cli.commands import new
from msmpetsc.cli.main import parsed
from msmpetsc.errors import InputError
from msmpetsc.export.formats import FORMATS, export
from msmpetsc.results import baseline
from msmpetsc.results.reader import Result
from msmpetsc.results.xdmf import write_xdmf
from msmpetsc.study.charts.plot import COUNT, Chart, curve_styles, log_axis, save_png
from msmpetsc.study.report import write_report
from msmpetsc.study.runner import run_study
from msmpetsc.study.sizing.choice import PlannedMethod, put_into, tables
from msmpetsc.study.table import write_table
from msmpetsc.view.composition import Style
from msmpetsc.view.drawable import drawable_of_result
from msmpetsc.view.film import write_pictures
from msmpetsc.view.page import write_page
from msmpetsc.view.sheet import contact_sheet

PACKAGE = ROOT / "msmpetsc"
Write = Callable[[Path], object]


class Writer(NamedTuple):
    """A writer: its module, a call that writes below a path, and files that must exist before."""

    module: str
    write: Write
    prepare: Write = lambda path: None


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with results to draw and export."""
    folder = tmp_path_factory.mktemp("sources")
    small_result.write(folder / "bar.h5")
    write_ball(folder / "ball.h5")
    return folder


def film(path: Path) -> None:
    pictures = np.random.default_rng(1).integers(0, 255, (3, 64, 64, 3), np.uint8)
    write_pictures(path, pictures, (64, 64), 10)


def page(result: Path, path: Path) -> None:
    with Result(result) as run:
        write_page(drawable_of_result(run), path, [0, 1], Style())


def chart(path: Path) -> None:
    made = Chart(path.stem, "sizes", "a title", "", curve_styles(["a", "b"]))
    axis = log_axis("x", [1, 10], COUNT)
    made.panel("", axis, axis).stair([1, 10], [1, 10])
    save_png(made, path.parent)


def ask_for_no_cases(path: Path) -> None:
    """Write a study file whose cases all need --full.

    So run_study stores its request and runs nothing.
    """
    scene = ROOT / "scenes" / "studies" / "beam_soft.toml"
    text = f'[[scene]]\nname = "a"\nfile = "{scene}"\n[[sweep]]\nfull = true\n'
    path.parent.with_name("asked.toml").write_text(text)


def writers(sources: Path) -> dict[str, Writer]:
    """Return the writers by names of their files."""
    bar, ball = sources / "bar.h5", sources / "ball.h5"
    to_plan = "[time] # mine\nstep = 0.1\nduration = 1.0\n"
    planned = tables(PlannedMethod("verlet"))

    def from_pile(path: Path) -> None:
        new.run(parsed(["new", str(path), "--from", "pile"]))

    def studied(path: Path) -> None:
        run_study(path.parent.with_name("asked.toml"), path.parent)

    def no_rows(path: Path) -> None:
        write_table(path.parent, [])

    def result(path: Path) -> None:
        small_result.write(path.with_suffix(".h5"))

    def xdmf(path: Path) -> None:
        write_xdmf(path.with_suffix(".h5"))

    table = {
        "x.h5": Writer("results/writer.py", small_result.write),
        "x.xdmf": Writer("results/xdmf.py", xdmf, result),
        "x.toml": Writer("cli/commands/new.py", from_pile),
        "x.baseline.json": Writer("results/baseline.py", lambda x: baseline.write(x, NUMBERS)),
        "planned.toml": Writer(
            "study/sizing/choice.py",
            lambda x: put_into(x, planned),
            lambda x: x.write_text(to_plan),
        ),
        "table.csv": Writer("study/table.py", no_rows),
        "study.toml": Writer("study/runner.py", studied, ask_for_no_cases),
        "report.html": Writer("study/report.py", lambda x: write_report(x.parent), no_rows),
        "chart.png": Writer("study/charts/plot.py", chart),
    }
    draw, show = partial(contact_sheet, ball), partial(page, ball)
    table |= {f"y{end}": Writer("export/formats.py", partial(export, bar)) for end in FORMATS}
    table |= {f"z{end}": Writer("view/sheet.py", draw) for end in PICTURE_NAMES}
    table |= {f"z{end}": Writer("view/film.py", film) for end in MOVIE_NAMES}
    return table | {f"z{end}": Writer("view/page.py", show) for end in PAGE_NAMES}


RECIPE = baseline.Recipe(cells=None, steps=1)
NUMBERS = baseline.Numbers(run=RECIPE, counts={}, scales={}, numbers={})
NAMES = [*writers(Path())]
# writers that never end a run, or that only a run can call; they use the same function
NOT_TRIED = {"app/summary.py", "app/exported_systems.py", "cli/commands/series.py"}


@contextmanager
def room_for(size: int) -> Iterator[None]:
    """Limit the length of every file [byte] within the context."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("name", NAMES)
def test_a_disk_that_fills_up(sources: Path, tmp_path: Path, name: str):
    """Fail at the first byte, or when half is written."""
    if name.startswith("y.usd"):
        pytest.importorskip("pxr", reason="usd-core is not installed: the extra usd")
    writer = writers(sources)[name]
    whole, full = tmp_path / "whole" / name, tmp_path / "full" / name
    for path in (whole, full):
        path.parent.mkdir()
        writer.prepare(path)
    before = contents(full.parent)
    writer.write(whole)
    for size in (0, whole.stat().st_size // 2):
        with room_for(size):
            text = input_error(lambda: writer.write(full))
        assert re.search("File too large|cannot be written", text) and str(full.parent) in text
        left, made = contents(full.parent), contents(whole.parent)
        assert left.get(name) == before.get(name)
        # files written earlier are complete
        for other in left.keys() - {name}:
            assert left[other] == before.get(other, made[other]), other
    writer.write(full)
    assert full.stat().st_size > 0


def test_an_older_file_stays_where_a_new_one_fails(sources: Path, tmp_path: Path):
    path = tmp_path / "x.obj"
    path.write_text("old")
    path.chmod(0o640)
    with room_for(10), pytest.raises(InputError):
        export(sources / "bar.h5", path)
    assert contents(tmp_path) == {"x.obj": b"old"}
    (tmp_path / "link.obj").symlink_to(path)
    export(sources / "bar.h5", tmp_path / "link.obj")
    assert (tmp_path / "link.obj").is_symlink() and path.stat().st_size > 3
    assert path.stat().st_mode & 0o777 == 0o640


BY_HAND = re.compile(
    r"\.write_text\(|\.write_bytes\(|os\.replace\(|\.savefig\(|open\([^)\n]*\"[wax]|File\([^)\n]*\"w"
)
ALLOWED = {
    "results/disk.py": "the one way",
    "results/writer.py": "a result, which grows",
    "export/formats.py": "under the name that the one way gave",
    "results/xdmf.py": "under the name that the one way gave",
    "backend/kernel_cache.py": "a cache",
    "study/process.py": "the log of a child",
    "study/runner.py": "a result that a child wrote gets its name",
    "view/renderer.py": "/dev/null",
}


def test_nothing_is_written_by_hand():
    texts = {str(path.relative_to(PACKAGE)): path.read_text() for path in PACKAGE.rglob("*.py")}
    assert {name for name, text in texts.items() if BY_HAND.search(text)} == ALLOWED.keys()
    ways = re.compile(r"import .*\b(whole_file|write_whole)\b")
    users = {name for name, text in texts.items() if ways.search(text)}
    tried = {writer.module for writer in writers(Path()).values()}
    assert users | {"results/writer.py"} == tried | NOT_TRIED
