"""msmpetsc compare: its errors by their formulas, and the first frame and node that differ."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import small_result
from one_process import command_error
from small_result import DT, FRAMES, NODES, POINTS, frame, number, position

from msmpetsc.cli.main import main
from msmpetsc.errors import InputError
from msmpetsc.results.comparison import (
    COMPARED,
    compare,
    compare_surfaces,
    difference,
    point_areas,
    rows_agree,
)
from msmpetsc.results.reader import Result
from msmpetsc.study.metrics import surface_error

# displacement of the sheared bar's top in the last frame [m]
DISPLACED = 0.1 * (FRAMES - 1) * 0.5


@pytest.fixture
def a(bar_result: Path) -> Path:
    return bar_result


def changed(tmp_path: Path, index: int, **values) -> Path:
    """Return a result whose frame ``index`` has other values."""
    frames = [frame(i, **(values if i == index else {})) for i in range(FRAMES)]
    return small_result.write(tmp_path / "b.h5", frames)


def moved(index: int, node: int, by: float) -> np.ndarray:
    q = position(index)
    q[node, 1] += by
    return q


def told(capsys, *arguments: object) -> tuple[int, str, str]:
    """Return the exit status and the output of the command."""
    status = main(["compare", *map(str, arguments)])
    said = capsys.readouterr()
    return status, said.out, said.err


def error_of(a: Path, b: Path, name: str) -> np.ndarray:
    with Result(a) as one, Result(b) as other:
        return next(field for field in compare(one, other).fields if field.name == name).errors


def test_a_file_agrees_with_itself(a: Path, capsys):
    status, out, _ = told(capsys, a, a, "--rtol", 0)
    assert status == 0 and "they agree" in out
    assert [line.split()[0] for line in out.splitlines()[1:-1]] == list(COMPARED)


def test_the_first_frame_and_node_that_differ_are_named(a: Path, tmp_path: Path, capsys):
    node = number(np.array([0.5, 0.5, 0]))
    b = changed(tmp_path, 2, position=moved(2, node, 1e-3 * DISPLACED))
    status, out, _ = told(capsys, a, b)
    assert status == 1 and "from frame 2 on, t = 0.02 s: position\n" in out
    assert f"node {node}, at rest at (0.5, 0.5, 0) m, is 0.0002 m off at frame 2" in out
    assert told(capsys, a, b, "--rtol", 1.001e-3)[0] == 0


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        # relative to the largest energy of the run, 2 * 4 J of the elastic energy
        ("kinetic", 3.008, 0.008 / 8),
        ("elastic", 6.0 + 8e-4, 1e-4),
        ("potential", -1.8, 0.1),
        # m = 12 * 0.25 kg, K = 4 J
        ("momentum", np.array([1, 0.03, 3]), 0.03 / np.sqrt(2 * 12 * 0.25 * 4)),
        # the body moves by 0.01 m a frame, so frame 4 is the farthest
        ("surface", POINTS + np.array([0.03, 0.004, 0]), 0.1),
    ],
)
def test_errors_are_relative_to_what_is_stated(
    a: Path, tmp_path: Path, name: str, value, error: float
):
    errors = error_of(a, changed(tmp_path, 3, **{name: value}), name)
    # the surface has about six digits
    assert errors == pytest.approx([0, 0, 0, error, 0], rel=1e-4 if name == "surface" else 1e-9)


def test_what_costs_are_measured_does_not_count(a: Path, tmp_path: Path, capsys):
    b = changed(tmp_path, 3, wall_time=9.0, iterations=99, ksp_its=99, step_error=0.5)
    assert told(capsys, a, b)[0] == 0


def test_nan_equals_nan_and_nothing_else(a: Path, tmp_path: Path, capsys):
    nan = changed(tmp_path, 1, elastic=np.nan)
    assert told(capsys, nan, nan)[0] == 0
    status, out, _ = told(capsys, a, nan)
    assert status == 1 and "from frame 1 on" in out and " inf " in out
    shown = json.loads(told(capsys, a, nan, "--json")[1], parse_constant=pytest.fail)
    assert shown["fields"]["elastic"]["error"] is None
    assert shown["fields"]["elastic"]["first_above"] == 1
    pairs = [(np.nan, np.nan), (np.nan, 1), (np.inf, np.inf), (np.inf, -np.inf), (1, np.inf)]
    assert difference(*np.transpose(pairs)).tolist() == [0, np.inf, 0, np.inf, np.inf]


def test_rounding_is_no_difference(tmp_path: Path):
    """A body at rest moves by rounding, and its surface is in single precision."""
    still = dict(kinetic=0.0, elastic=1e-30, potential=0.0, momentum=np.zeros(3))

    def written(factor: float, **other) -> Path:
        places = dict(position=NODES * factor, surface=POINTS * factor)
        frames = [frame(i, **places | still | other) for i in (0, 1)]
        return small_result.write(tmp_path / f"{factor}.h5", frames)

    more = written(1 + 1e-15, elastic=2e-30, momentum=np.full(3, 1e-20))
    with Result(more) as a, Result(written(1 - 1e-15)) as b:
        assert all(field.first_above(1e-6) is None for field in compare(a, b).fields)


def test_other_times_are_compared_where_shared_and_count(a: Path, tmp_path: Path, capsys):
    b = small_result.write(tmp_path / "b.h5", [frame(index) for index in (0, 2, 4)])
    status, out, _ = told(capsys, a, b)
    assert status == 1 and "they agree" in out
    assert "5 and 3 frames, of which 3 have the same time" in out
    late = small_result.write(tmp_path / "c.h5", [frame(0, time=0.5)])
    status, _, said = told(capsys, a, late)
    assert status == 2 and "no finished frame of the same time" in said


def test_frames_are_numbered_as_in_the_first_file(a: Path, tmp_path: Path, capsys):
    b = small_result.write(tmp_path / "b.h5", [frame(2), frame(3, kinetic=5.0), frame(4)])
    for pair, index in (((a, b), 3), ((b, a), 1)):
        assert f"from frame {index} on, t = {3 * DT:g} s: kinetic" in told(capsys, *pair)[1]


def test_fields_that_one_alone_has_are_told(a: Path, tmp_path: Path, capsys):
    frames = [frame(i, surface=None) for i in range(FRAMES)]
    b = small_result.write(tmp_path / "b.h5", frames, surface=False)
    status, out, _ = told(capsys, b, a)
    assert status == 0 and f"surface is in {a} only: not compared" in out


@pytest.mark.parametrize(
    ("lattice", "reason"),
    [
        (dict(nodes=np.vstack([NODES, [[9, 9, 9]]]), mass=np.ones(13)), "12 and 13 nodes"),
        (dict(nodes=NODES + np.array([1e-3, 0, 0])), r"node 0 rests at \(0, 0, 0\) m in one"),
    ],
)
def test_other_lattices_are_refused_with_the_reason(
    a: Path, tmp_path: Path, lattice: dict, reason: str
):
    n = len(lattice.get("nodes", NODES))
    frames = [frame(i, position=np.zeros((n, 3)), surface=None) for i in range(2)]
    b = small_result.write(tmp_path / "b.h5", frames, surface=False, **lattice)
    assert re.search(reason, command_error("compare", a, b))


def other_lattice(path: Path, by: float = 0.0, points: np.ndarray = POINTS) -> Path:
    """Return a run on a lattice twice as coarse; from frame 2 on, surface point 3 is displaced."""
    frames = [frame(i, surface=points + 0.01 * i * small_result.X) for i in range(FRAMES)]
    for one in frames[2:]:
        one.surface[3, 1] += by
    return small_result.write(path, frames, points=points, nodes=2 * NODES)


def test_runs_of_one_mesh_on_other_lattices_are_compared_by_their_surfaces(
    a: Path, tmp_path: Path, capsys
):
    b = other_lattice(tmp_path / "b.h5", by=0.02)
    status, out, _ = told(capsys, a, b)
    # largest displacement in b
    largest = np.hypot(0.04, 0.02)
    assert status == 1 and "their surfaces alone are compared" in out
    assert "from frame 2 on, t = 0.02 s: surface, surface, rms" in out
    assert "surface point 3, at rest" in out
    with Result(a) as one, Result(b) as other:
        _, mean = compare_surfaces(one, other).fields
        assert mean.scale == pytest.approx(largest, rel=1e-6)
        areas = areas_of(one)
    rms = 0.02 * np.sqrt(areas[3] / areas.sum())
    assert mean.errors * mean.scale == pytest.approx([0, 0, rms, rms, rms], rel=1e-4, abs=1e-8)
    assert surface_error(a, b) == pytest.approx(rms * np.sqrt(3 / 5) / largest, rel=1e-4)
    assert f"surface error {surface_error(a, b):.3g}: " in out
    assert told(capsys, a, b, "--rtol", "1")[0] == 0


def areas_of(run: Result) -> np.ndarray:
    return point_areas(run["surface/points"][:], run.indices("surface/triangles"))


def test_points_count_by_the_area_around_them(a: Path):
    with Result(a) as run:
        p, areas = POINTS, areas_of(run)
    first, second = (
        np.linalg.norm(np.cross(p[b] - p[a], p[c] - p[a])) / 6 for a, b, c in ((0, 1, 2), (1, 2, 3))
    )
    assert areas == pytest.approx([first, first + second, first + second, second])


def test_other_meshes_are_refused_in_one_line(a: Path, tmp_path: Path):
    b = other_lattice(tmp_path / "b.h5", points=POINTS + np.outer([0, 0, 1, 0], [0, 0.01, 0]))
    assert "different meshes: surface point 2" in command_error("compare", a, b)
    with pytest.raises(InputError, match="nothing moves"):
        still = small_result.write(tmp_path / "still.h5", [frame(0)])
        surface_error(a, still)


@pytest.mark.parametrize(
    "options", [["--rtol", "nan"], ["--rtol", "-1"], ["--rtol", "x"], ["--field"]]
)
def test_odd_options_are_refused(a: Path, options: list[str]):
    assert command_error("compare", a, a, *options)


@pytest.mark.parametrize("shape", [(0,), (0, 3)])
def test_no_rows_agree(shape: tuple[int, ...]):
    """Arrays without rows agree, as for a rank without a pin."""
    assert rows_agree(np.zeros(shape), np.zeros(shape), 0.0).shape == (0,)
