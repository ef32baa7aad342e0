"""Damaged and hostile result files: run --resume continues, or refuses in a line."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from one_process import command_error, status_of
from stopped_runs import hanging, stopped_after

from msmpetsc.solve import simulate


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stopped")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulate, "REMEMBERED", 4)
        assert stopped_after(4, "run", hanging(folder, steps=6), "-o", folder / "x.h5") == 0
    return folder / "x.h5"


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


def as_floats(file: h5py.File, name: str) -> None:
    rows = file[name][...]
    del file[name]
    file[name] = rows.astype("f8")


def number(value: float):
    def change(file: h5py.File, name: str) -> None:
        numbers = file["checkpoint/numbers"]
        at = numbers.attrs["names"].split().index(name)
        numbers[:, at] = value

    return change


def value(number: float):
    def change(file: h5py.File, name: str) -> None:
        file[name][-1] = number

    return change


def not_toml(file: h5py.File, name: str) -> None:
    file.attrs[name] = "x"


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
    (value(np.nan), "checkpoint/q"), (as_floats, "checkpoint/step"),
    # a step beyond the end of the run
    (value(12), "checkpoint/step"),
    (not_toml, "scene"),
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


def test_options_that_no_shell_could_split_are_refused(stopped, tmp_path):
    path = tmp_path / "x.h5"
    path.write_bytes(stopped.read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["petsc_options"] = "-pc_type 'x"
    assert "its PETSc options cannot be parsed" in command_error("run", "--resume", path)
