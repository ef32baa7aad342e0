"""Damaged and hostile result files: run --resume continues, or refuses in a line."""

import re
import signal
from pathlib import Path

import h5py
import numpy as np
import pytest
from bad_input import TRIALS, damage, damaged, limits
from hypothesis import example, given, settings
from hypothesis import strategies as st
from one_process import status_of
from stopped_runs import hanging, signal_after

from msmpetsc.solve import simulate

NAMES = [
    f"checkpoint/{name}"
    for name in ("step", "q", "q_previous", "numbers", "lowest_mode", "new\nline")
]
NAMES += ["frames/time", "frames/position", "frames/kinetic", "lattice/nodes", "lattice/mass"]
VALUES = st.sampled_from([np.nan, np.inf, -1.0, 0.0, 3.0, 12.0, 1e308])
SHAPES = st.lists(st.sampled_from([0, 1, 2, 3, 75, 10**12]), max_size=4).map(tuple)
KINDS = st.sampled_from(["f8", "f4", ">f8", "i8", "S3", h5py.string_dtype()])
ATTRIBUTES = st.sampled_from(
    ["scene", "scene_file", "petsc_options", "true_error", "msmpetsc_version", "format_version"]
)
TEXTS = st.sampled_from(
    ["", "x", "-", "-snes_type", "-pc_type 'x", "-ksp_type none", "/etc/passwd", "\x1b[31m\n", "-1"]
)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stopped")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulate, "REMEMBERED", 4)
        signal_after(patch, 4, signal.SIGUSR1)
        assert status_of("run", hanging(folder, steps=6), "-o", folder / "x.h5") == 0
    return folder / "x.h5"


def change(file: h5py.File, kind: str, name: str, what) -> None:
    if kind == "attribute":
        file.attrs[name] = what
    elif kind == "scene":
        file.attrs["scene"] = (
            damaged(file.attrs["scene"].encode(), what).decode(errors="replace").replace("\0", "0")
        )
    elif kind == "value" and name in file and file[name].size and file[name].dtype.kind in "if":
        rows = file[name][...]
        with np.errstate(all="ignore"):
            rows.flat[-1] = np.array(what).astype(rows.dtype)
        file[name][...] = rows
    elif kind == "dataset":
        file.pop(name, None)
        file.create_dataset(name, *what, chunks=True if all(what[0]) and what[0] else None)


edit = st.one_of(
    st.tuples(
        st.just("attribute"),
        ATTRIBUTES,
        st.one_of(TEXTS, st.sampled_from([7, -1, 2.5, np.arange(3)])),
    ),
    st.tuples(st.just("scene"), st.none(), damage),
    st.tuples(st.just("value"), st.sampled_from(NAMES), VALUES),
    st.tuples(st.just("dataset"), st.sampled_from(NAMES), st.tuples(SHAPES, KINDS)),
)


@pytest.mark.slow
@settings(TRIALS, max_examples=40)
@given(edits=st.lists(edit, min_size=1, max_size=2))
# no shell could split these words
@example(edits=[("attribute", "petsc_options", "-pc_type 'x")])
@example(edits=[("attribute", "true_error", "x")])
@example(edits=[("dataset", "checkpoint/step", ((2,), "f8"))])
@example(edits=[("value", "checkpoint/q", np.nan)])
# a step beyond the end of the run
@example(edits=[("value", "checkpoint/step", 12.0)])
def test_it_goes_on_or_says_in_one_line_why_not(stopped, tmp_path, capsys, edits):
    path = tmp_path / "x.h5"
    path.write_bytes(stopped.read_bytes())
    with h5py.File(path, "r+") as file:
        for one in edits:
            change(file, *one)
    capsys.readouterr()
    with limits():
        status = status_of("run", "--resume", path)
    told = [line for line in capsys.readouterr().err.splitlines() if "msmpetsc: error" in line]
    assert status in (0, 2, 3) and (status == 0) == (not told)
    assert all(line.isprintable() for line in told) and not any(
        re.search("Error|Traceback", line) for line in told
    )


def without(file: h5py.File, name: str) -> None:
    del file[name]


def a_group(file: h5py.File, name: str) -> None:
    del file[name]
    file.create_group(name)


def dangling(file: h5py.File, name: str) -> None:
    del file[name]
    file[name] = h5py.SoftLink("/nowhere")


def short(file: h5py.File, name: str) -> None:
    rows = file[name][...]
    del file[name]
    file[name] = rows[:, :1] if rows.ndim > 1 else rows[:1]


def number(value: float):
    def change(file: h5py.File, name: str) -> None:
        numbers = file["checkpoint/numbers"]
        at = numbers.attrs["names"].split().index(name)
        numbers[:, at] = value

    return change


DAMAGE = [
    (a_group, "frames/iterations"), (dangling, "frames/substeps"), (short, "frames/kinetic"),
    (short, "frames/ksp_its"),
    (short, "frames/momentum"), (without, "checkpoint/lowest_mode"),
    (a_group, "checkpoint/lowest_mode"),
    (short, "checkpoint/lowest_mode"), (a_group, "checkpoint/q"), (a_group, "checkpoint/numbers"),
    (dangling, "checkpoint/step"), (without, "surface/triangles"), (a_group, "surface/points"),
    (short, "lattice/springs"), (without, "lattice/cells"), (dangling, "embedding/weights"),
    (dangling, "lattice/cell_kind"), (a_group, "frames/surface"),
    (number(5), "LowestCurvature.knows_mode"),
    (number(np.inf), "Monitors.work.iterations"), (number(np.nan), "put_in"),
    (number(-1), "Monitors.frames"), (number(np.nan), "LowestCurvature.searched.total"),
]  # fmt: skip


@pytest.mark.parametrize(("how", "name"), DAMAGE)
def test_a_damaged_part_is_named_in_one_line(stopped, tmp_path, capsys, how, name):
    path = tmp_path / "x.h5"
    path.write_bytes(stopped.read_bytes())
    with h5py.File(path, "r+") as file:
        how(file, name)
    before = path.read_bytes()
    assert status_of("run", "--resume", path) == 2
    told = [line for line in capsys.readouterr().err.splitlines() if "msmpetsc: error" in line]
    assert len(told) == 1 and name.rpartition("/")[2] in told[0]
    assert path.read_bytes() == before
