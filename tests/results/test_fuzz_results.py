"""Damaged or hostile result files are read or refused in a line; no other file is opened."""

import argparse
from pathlib import Path

import h5py
import numpy as np
import pytest
from bad_input import TRIALS, refusal
from hypothesis import given, settings
from hypothesis import strategies as st

import msmpetsc
from msmpetsc.cli.commands import compare
from msmpetsc.results.checkpoint_reader import Earlier

SECRET = 7.25


def read_all(path: Path) -> None:
    with msmpetsc.open(path) as run:
        for arrays in (run.lattice, run.surface, run.frames):
            for name in arrays:
                arrays[name][:]
        _ = run.embedding


def compared(one: Path, other: Path) -> None:
    compare.run(argparse.Namespace(first=one, second=other, rtol=1e-6, json=False))


NAMES = [
    "lattice/nodes", "lattice/cells", "lattice/springs", "lattice/mass", "surface/points",
    "surface/triangles", "embedding/indptr", "embedding/indices", "embedding/weights",
    "frames/time", "frames/position", "frames/kinetic", "frames/iterations", "checkpoint/step",
    "checkpoint/q", "checkpoint/q_previous", "frames/new\nline",
]  # fmt: skip
SHAPES = st.lists(st.sampled_from([0, 1, 2, 3, 5, 12, 10**12]), max_size=4).map(tuple)
OBJECTS = (h5py.string_dtype(), h5py.vlen_dtype("f8"), h5py.ref_dtype)
TYPES = st.sampled_from(["f8", "f4", ">f8", "i8", "u1", "S3", "c16", *OBJECTS])
VALUES = st.sampled_from([np.nan, np.inf, -1, 0, 12, 1e308, 2**62])
EDIT = st.tuples(st.sampled_from(NAMES), SHAPES, TYPES, VALUES, st.booleans(), st.booleans())


@settings(TRIALS, max_examples=25)
@given(edits=st.lists(EDIT, min_size=1, max_size=2))
def test_other_contents_are_read_or_refused(bar_result, tmp_path, capfd, edits):
    path = tmp_path / "x.h5"
    path.write_bytes(bar_result.read_bytes())
    with h5py.File(path, "r+") as file:
        for name, shape, kind, value, one_value, packed in edits:
            if one_value and name in file and file[name].size and file[name].dtype.kind in "iuf":
                with np.errstate(all="ignore"):
                    rows = file[name][...]
                    rows.flat[0] = np.array(value).astype(rows.dtype)
                    file[name][...] = rows
                continue
            file.pop(name, None)
            packed = packed and all(shape) and shape
            filters = dict(chunks=(1,) * len(shape), compression="gzip") if packed else {}
            file.create_dataset(name, shape, kind, **filters)
    refusal(lambda: read_all(path))
    refusal(lambda: compared(bar_result, path))
    refusal(lambda: Earlier.read(path))


def replaced(file: h5py.File, name: str, by) -> None:
    del file[name]
    file[name] = by


def external(file: h5py.File, name: str, folder: Path) -> None:
    shape = file[name].shape
    del file[name]
    elsewhere = [(str(folder / "secret.bin"), 0, h5py.h5f.UNLIMITED)]
    file.create_dataset(name, shape, "f8", external=elsewhere)


def virtual(file: h5py.File, name: str, folder: Path) -> None:
    layout = h5py.VirtualLayout(file[name].shape, "f8")
    layout[...] = h5py.VirtualSource(str(folder / "secret.h5"), "rows", file[name].shape)
    del file[name]
    file.create_virtual_dataset(name, layout)


def linked(file: h5py.File, name: str, folder: Path) -> None:
    replaced(file, name, h5py.ExternalLink(str(folder / "secret.h5"), "/rows"))


def linked_twice(file: h5py.File, name: str, folder: Path) -> None:
    file["way"] = h5py.ExternalLink(str(folder / "secret.h5"), "/rows")
    replaced(file, name, h5py.SoftLink("/way"))


def linked_group(file: h5py.File, name: str, folder: Path) -> None:
    replaced(file, name.partition("/")[0], h5py.ExternalLink(str(folder / "secret.h5"), "/"))


ELSEWHERE = [linked, linked_twice, linked_group, external, virtual]


@pytest.mark.parametrize("name", ["frames/position", "lattice/nodes", "checkpoint/q"])
@pytest.mark.parametrize("how", ELSEWHERE)
def test_no_other_file_is_followed(bar_result, tmp_path, name, how):
    path = tmp_path / "x.h5"
    path.write_bytes(bar_result.read_bytes())
    with h5py.File(path, "r+") as file:
        shape = file[name].shape
        how(file, name, tmp_path)
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["rows"] = np.full(shape, SECRET)
    (tmp_path / "secret.bin").write_bytes(np.full(shape, SECRET).tobytes())
    said = refusal(lambda: msmpetsc.open(path))
    assert "not followed" in said or "not opened" in said


def test_names_and_versions_act_on_no_terminal(bar_result, tmp_path):
    path = tmp_path / "x.h5"
    path.write_bytes(bar_result.read_bytes())
    with h5py.File(path, "r+") as file:
        # too short for a frame, and left unchanged
        file["frames/\x1b[31m"] = np.ones(2)
    assert not refusal(lambda: read_all(path))
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = "\x1b[31m" + "x" * 5000
    assert "format_version ?[31mx" in refusal(lambda: msmpetsc.open(path))
