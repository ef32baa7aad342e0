"""msmpetsc.open reads running and old files; a bad file gives a line of error."""

import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import small_result
from mpi4py import MPI
from small_result import DT, FRAMES, NODES, POINTS, frame, position

import msmpetsc
from msmpetsc.errors import InputError
from msmpetsc.results.writer import ResultFile


@pytest.fixture
def copy(bar_result: Path, tmp_path: Path) -> Path:
    path = tmp_path / "x.h5"
    path.write_bytes(bar_result.read_bytes())
    return path


def test_what_was_written_is_read(bar_result: Path):
    with msmpetsc.open(bar_result) as run:
        assert run.frames.time[:] == pytest.approx(DT * np.arange(FRAMES))
        assert np.array_equal(run.frames.position[-1], position(FRAMES - 1))
        assert run.frames.position.unit == "m"
        assert np.array_equal(run.lattice["nodes"], NODES) and run.lattice.cells.shape == (2, 8)
        assert run.scene["material"]["density"] == 1000 and run.attributes["ranks"] == 1
        assert run.surface.triangles[1, 2] == 3
        assert run.embedding.shape == (len(POINTS), len(NODES))
        assert np.allclose(run.embedding @ np.ones(len(NODES)), 1)
        assert "5 frames of 12 nodes" in repr(run) and "elastic" in dir(run.frames)
        assert len(run.frames) == FRAMES and {"time", "position"} < set(run.frames)
    with pytest.raises(InputError, match="is closed"):
        run.frames.kinetic[0]


@pytest.mark.parametrize(
    "key",
    [
        3, -1, np.int64(2), slice(None), slice(4, 1), (slice(1, 3), 7), (slice(None), 7, 2), ...,
        (..., 1), (),
        ([0, 2], 5), (slice(None), [3, 5]), (2, [1, 4]), [], np.arange(FRAMES) > 2,
        ([True, False, True, False, False], slice(2)), (slice(0), [1, 2]),
    ],
)  # fmt: skip
def test_lazy_arrays_are_indexed_as_numpys(bar_result: Path, key):
    with msmpetsc.open(bar_result) as run:
        expected = np.array([position(index) for index in range(FRAMES)])[key]
        found = run.frames.position[key]
        assert found.shape == expected.shape and found.dtype == expected.dtype
        assert np.array_equal(found, expected)


@pytest.mark.parametrize(
    "key",
    [
        5, -6, (0, 12), (0, 0, 0, 0), None, ([0, 1], [0, 1]), (..., 0, ...), slice(None, None, -1),
        [4, 0],
    ],
)  # fmt: skip
def test_what_is_not_there_is_an_index_error(bar_result: Path, key):
    with msmpetsc.open(bar_result) as run, pytest.raises(IndexError):
        run.frames.position[key]


def test_a_file_that_is_being_written_has_its_finished_frames(tmp_path: Path):
    with ResultFile(tmp_path / "x.h5", MPI.COMM_SELF, {}) as file:
        file.write("lattice/nodes", NODES)
        file.start_frames(1000, len(NODES), {"surface": len(POINTS)})
        with msmpetsc.open(tmp_path / "x.h5") as run:
            assert run.frames.position[:].shape == (0, *NODES.shape)
        for index in range(3):
            file.append(frame(index))
        with msmpetsc.open(tmp_path / "x.h5") as run:
            file.append(frame(3))
            assert len(run.frames) == len(run.frames.time) == len(list(run.frames.position)) == 3
            assert np.array_equal(run.frames.position[-1], position(2))
            assert np.isfinite(run.frames.time).all()


DIMENSIONS = {
    "kinetic": ("time",),
    "momentum": ("time", "axis"),
    "position": ("time", "node", "axis"),
    "surface": ("time", "point", "axis"),
    "stress": ("time", "node", "component"),
    "cell_von_mises": ("time", "cell"),
}


def test_axes_of_frames_have_names_and_coordinates(tmp_path: Path):
    stress = {"stress": np.ones((len(NODES), 6)), "cell_von_mises": np.ones(2)}
    path = small_result.write(tmp_path / "x.h5", [frame(k, **stress) for k in range(3)])
    with h5py.File(path) as file:
        frames = file["frames"]
        for name, dimensions in DIMENSIONS.items():
            names = (axis[0].name.removeprefix("/frames/") for axis in frames[name].dims)
            assert tuple(names) == dimensions
        assert frames["axis"].asstr()[:].tolist() == ["x", "y", "z"]
        assert frames["component"].asstr()[:].tolist() == ["xx", "yy", "zz", "xy", "yz", "xz"]
        assert frames["node"].id.get_storage_size() == 0


@pytest.mark.parametrize("ours_first", [True, False])
def test_a_result_opens_beside_another_reader_of_the_process(bar_result: Path, ours_first: bool):
    openers = [msmpetsc.open, h5py.File]
    first, second = (opener(bar_result) for opener in (openers if ours_first else openers[::-1]))
    with first, second:
        assert len(first["frames/time"]) == len(second["frames/time"]) == FRAMES


@pytest.mark.parametrize("engine", ["h5netcdf", "netcdf4"])
def test_xarray_has_names_coordinates_and_units(bar_result: Path, engine: str):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip({"netcdf4": "netCDF4"}.get(engine, engine))
    with (
        msmpetsc.open(bar_result) as run,
        xarray.open_dataset(bar_result, group="frames", engine=engine) as frames,
    ):
        assert frames.position.dims == DIMENSIONS["position"]
        assert set(frames.coords) == {"time", "axis"}
        height = frames.position.sel(axis="z").sel(time=2 * DT, method="nearest")
        assert np.array_equal(height, run.frames.position[2][:, 2])
        assert frames.kinetic.attrs["units"] == "J" and frames.time.attrs["units"] == "s"


def test_the_embedding_names_the_extra_that_it_needs(bar_result: Path, monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.sparse", None)
    with (
        msmpetsc.open(bar_result) as run,
        pytest.raises(InputError, match=r"scipy .* 'msmpetsc\[render\]' brings it"),
    ):
        _ = run.embedding


def test_a_file_of_an_older_version_is_read_without_what_it_lacks(copy: Path):
    with h5py.File(copy, "r+") as file:
        for name in ("contact", "true_error", "surface"):
            del file["frames"][name]
        for name in ("lattice/pinned", "embedding", "surface", "checkpoint"):
            del file[name]
    with msmpetsc.open(copy) as run:
        assert "contact" not in run.frames and "points" not in run.surface
        assert run.embedding is None
        with pytest.raises(AttributeError, match="no frames/contact in this file, but time, p"):
            _ = run.frames.contact


def test_a_repacked_file_is_read(copy: Path):
    with h5py.File(copy, "r+") as file:
        for name in ("lattice/nodes", "frames/position"):
            rows = file[name][:]
            del file[name]
            file.create_dataset(name, data=rows, compression="gzip")
    with msmpetsc.open(copy) as run:
        assert np.array_equal(run.frames.position[2], position(2))


def damage(change: Callable[[h5py.File], None]) -> Callable[[Path], None]:
    def apply(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            change(file)

    return apply


def replaced(name: str, rows=None, **options) -> Callable[[Path], None]:
    def change(file: h5py.File) -> None:
        del file[name]
        if rows is not None or options:
            file.create_dataset(name, data=rows, **options)

    return damage(change)


def attribute(name: str, value) -> Callable[[Path], None]:
    return damage(
        lambda file: file.attrs.pop(name) if value is None else file.attrs.__setitem__(name, value)
    )


def cut(part: float) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(path.read_bytes()[: int(part * path.stat().st_size)])


def without_header(name: str) -> Callable[[Path], None]:
    """Return the damage of a file that lost the header of a group or dataset."""

    def apply(path: Path) -> None:
        with h5py.File(path) as file:
            place = h5py.h5o.get_info(file[name].id).addr
        with path.open("r+b") as data:
            data.seek(place)
            data.write(bytes(64))

    return apply


HUGE = dict(shape=(10**12,), dtype="f8", chunks=(1000,))
BAD = {
    "cut in half": (cut(0.5), "is damaged or cut short: .*truncated"),
    "empty": (cut(0), "is not an HDF5 file"),
    "gone": (lambda path: path.unlink(), "no such file"),
    "folder": (lambda path: (path.unlink(), path.mkdir()), "is a folder"),
    "foreign": (lambda path: h5py.File(path, "w").close(), "is not a result of msmpetsc run"),
    "newer": (attribute("format_version", 2), "format_version 2; 1 is read here"),
    "no frames": (damage(lambda file: file.__delitem__("frames")), "no dataset frames/time"),
    "no header": (without_header("frames"), "is damaged or cut short: Unable to"),
    "no time": (replaced("frames/time"), "no dataset frames/time"),
    "no nodes": (replaced("lattice/nodes"), "no dataset lattice/nodes"),
    "10^12 nodes": (
        replaced("lattice/nodes", **HUGE | dict(shape=(10**12, 3), chunks=(99, 3))),
        "claims 1000000000000 x 3"
    ),
    "text for positions": (replaced("frames/position", ["a", "b"]), "frames/position has type"),
    "one number for all": (replaced("frames/time", 1.0),
    "frames/time has type float64 and shape ()"),
    "other nodes": (replaced("lattice/nodes", np.ones((11, 3))),
    "12 long along axis 0, and 11 are expected"),
    "flat": (replaced("frames/position", np.ones((5, 12, 2))),
    "2 long along axis 2, and 3 are expected"),
    "too few energies": (replaced("frames/kinetic", np.ones(3)),
    "3 long along axis 0, and 5 frames are finished"),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_ends_in_one_line(copy: Path, name: str):
    spoil, words = BAD[name]
    spoil(copy)
    with pytest.raises(InputError, match=words) as told:
        msmpetsc.open(copy)
    assert str(told.value).startswith(str(copy)) and "\n" not in str(told.value)


def number(name: str, value: int) -> Callable[[Path], None]:
    """Return the change of a dataset's fourth row to a value."""
    return damage(lambda file: file[name].__setitem__(3, value))


@pytest.mark.parametrize(
    ("spoil", "ask", "words"),
    [
        (attribute("scene", None), "scene", "does not say its scene"),
        (attribute("scene", "a = [[["), "scene", "its scene is not TOML"),
        (number("embedding/indices", 10**6), "embedding", "embedding is no matrix"),
        (replaced("embedding/weights"), "embedding", "it has no embedding/weights"),
        (number("lattice/springs", -1), "springs", "springs has numbers outside its 12 nodes"),
    ],
)
def test_what_is_wrong_in_a_part_is_told_when_it_is_asked_for(
    copy: Path, spoil, ask: str, words: str
):
    spoil(copy)
    with msmpetsc.open(copy) as run, pytest.raises(InputError, match=words):
        _ = run.indices("lattice/springs") if ask == "springs" else getattr(run, ask)
