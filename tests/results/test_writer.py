"""The result file: its layout, on several ranks, killed, refused; and the XDMF file beside it."""

import io
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
import pytest
import small_result
from conftest import WORKERS, run
from frames_worker import NODES, POINTS, STEPS, frame, positions
from mpi4py import MPI

from msmpetsc.checkpoint import Checkpoint
from msmpetsc.errors import InputError
from msmpetsc.fields import FIELDS, FRAME_FIELDS
from msmpetsc.results import writer
from msmpetsc.results.checkpoint_reader import newest_slot
from msmpetsc.results.untrusted_file import finished, open_result
from msmpetsc.results.writer import Begin, ResultFile

WORKER = WORKERS / "frames_worker.py"


def run_on_ranks(ranks: int, action: str, path: Path) -> str:
    return run(ranks, WORKER, action, path, status=0).stdout


def assert_holds(file: h5py.File, count: int, surface: bool = True) -> None:
    """Assert that the first ``count`` frames are the frames of frames_worker, bit for bit."""
    expected = [frame(index) for index in range(count)]
    fields = {name: FRAME_FIELDS[name].dtype for name in FRAME_FIELDS.keys() & file["frames"]}
    numbers = {name for name, field in FRAME_FIELDS.items() if field.shape == ("T",)}
    assert {"position", *numbers} <= fields.keys()
    if not surface:
        fields.pop("surface", None)
    for name, kind in fields.items():
        stored = file["frames"][name][:count]
        wanted = np.array([getattr(one, name) for one in expected], kind).reshape(stored.shape)
        assert np.array_equal(stored, wanted, equal_nan=True), name


def newest_checkpoint(file: h5py.File) -> tuple[int, np.ndarray, np.ndarray] | None:
    """Return step, q and q_previous of a file's newest checkpoint; it need not have a path."""
    slot = newest_slot(file["checkpoint/step"][:])
    names = ("step", "q", "q_previous")
    return None if slot is None else tuple(file[f"checkpoint/{name}"][slot] for name in names)


@pytest.mark.parametrize("ranks", [1, 3])
def test_layout_is_that_of_the_design_on_any_ranks(tmp_path, ranks):
    # the run creates the folder
    run_on_ranks(ranks, "all", tmp_path / "out" / "x.h5")
    assert os.listdir(tmp_path / "out") == ["x.h5"]
    with h5py.File(tmp_path / "out" / "x.h5") as file:
        assert finished(file) == STEPS + 1
        assert_holds(file, STEPS + 1)
        attributes = {"format": "msmpetsc", "format_version": 1, "ranks": 3}
        assert {**file.attrs} == attributes | {"scene": "title = 'a test'"}
        for name, rows in (("position", NODES), ("surface", POINTS)):
            dataset = file["frames"][name]
            assert dataset.shape == (STEPS + 1, rows, 3) and dataset.dtype == "f8"
        assert np.array_equal(file["lattice/nodes"], positions(0, NODES))
        assert np.array_equal(file["lattice/springs"], np.arange(2 * NODES).reshape(-1, 2))
        assert file["lattice/pinned"].shape == (0,)
        units = {"frames/momentum": "kg m/s", "frames/elastic": "J", "lattice/nodes": "m"}
        assert {name: file[name].attrs["units"] for name in units} == units
        step, q, q_previous = newest_checkpoint(file)
        assert step == STEPS and np.array_equal(q, positions(STEPS, NODES))
        assert np.array_equal(q_previous, positions(STEPS - 1, NODES))


def test_who_writes_does_not_show_in_the_file(tmp_path):
    """The bytes are equal, whether rank 0 writes for all or each rank writes its own rows.

    The rows of a rank begin and end within chunks.
    """
    for ranks, action in ((1, "all"), (3, "all"), (3, "gathered")):
        run_on_ranks(ranks, action, tmp_path / f"{ranks} {action}.h5")
    one, *others = [path.read_bytes() for path in sorted(tmp_path.glob("*.h5"))]
    assert len(others) == 2 and all(other == one for other in others)


def test_no_write_leaves_a_broken_file(tmp_path, monkeypatch):
    """After each replayed write the file opens and holds all finished frames."""
    disk, path = Disk(), tmp_path / "x.h5"
    disk.replace_file(monkeypatch)
    # number of writes -> (frames, newest checkpoint) that were complete by then
    marks = {}
    file = ResultFile(path, MPI.COMM_SELF, {})
    file.start_frames(40, NODES, {"surface": POINTS})
    for index in range(12):
        marks[len(disk.log)] = index, index - 1
        file.append(frame(index))
        marks[len(disk.log)] = index + 1, index - 1
        file.write_checkpoint(saved(index))
    marks[len(disk.log)] = 12, 11
    file.close()

    for writes, image in disk.images(start=min(marks)):
        count, checkpoint = marks[max(mark for mark in marks if mark <= writes)]
        with h5py.File(io.BytesIO(image), "r") as killed:
            assert count <= finished(killed) <= count + 1 and finished(killed) <= 12
            assert_holds(killed, finished(killed))
            kept = newest_checkpoint(killed)
            if checkpoint >= 0:
                assert kept[0] in (checkpoint, checkpoint + 1)
                assert np.array_equal(kept[1], positions(kept[0], NODES))
                assert np.array_equal(kept[2], positions(kept[0] - 1, NODES))


def test_going_on_writes_nothing_but_numbers_in_their_places(tmp_path, monkeypatch):
    """The same holds from the opening of a file that a kill has left until it is closed."""
    path, disk = tmp_path / "x.h5", Disk()
    with ResultFile(path, MPI.COMM_SELF, {}) as file:
        write_frames(file, range(3))
    before = path.read_bytes()
    io.BytesIO.write(disk, before)
    disk.replace_file(monkeypatch)
    with ResultFile(path, MPI.COMM_SELF, {}, Begin.IN_PLACE) as file:
        write_frames(file, range(3, 6))
    with h5py.File(io.BytesIO(before)) as laid:
        numbers = sorted(places(laid))
    # the file was neither cut nor extended
    assert {change for change in disk.log if isinstance(change, int)} <= {len(before)}
    for offset, data in [change for change in disk.log if not isinstance(change, int)]:
        changed = [at for at, byte in enumerate(data, offset) if byte != before[at]]
        inside = [any(start <= at < end for start, end in numbers) for at in changed]
        assert all(inside)
    for _, image in disk.images(start=1, begin=before):
        with h5py.File(io.BytesIO(image), "r") as killed:
            assert_holds(killed, finished(killed))
            step, q, _ = newest_checkpoint(killed)
            assert step in (finished(killed) - 1, finished(killed) - 2)
            assert np.array_equal(q, positions(step, NODES))


def test_a_copy_of_frames_writes_their_numbers_together(tmp_path, monkeypatch):
    frames = [small_result.frame(index) for index in range(9)]
    path, sizes = tmp_path / "x.h5", (len(small_result.NODES), {"surface": len(frames[0].surface)})
    writes = []
    for kept in (4, 8):
        small_result.write(path, frames)
        with monkeypatch.context() as patched, h5py.File(path) as whole:
            disk = Disk()
            disk.replace_file(patched)
            with ResultFile(path, MPI.COMM_SELF, {}, Begin.COPY) as file:
                file.start_frames(12, *sizes, kept=kept)
            with h5py.File(disk) as copied:
                assert finished(copied) == kept
                for name in FRAME_FIELDS.keys() & copied["frames"]:
                    both = (file["frames"][name][:kept] for file in (copied, whole))
                    assert np.array_equal(*both, equal_nan=True), name
        writes.append(len(disk.log))
        path.unlink()
    # more frames take more writes for nodes and points alone
    assert writes[1] - writes[0] == 2 * 4


def write_frames(file: ResultFile, indices: range) -> None:
    """Lay out nine frames and write some of them, each with a checkpoint."""
    file.start_frames(9, NODES, {"surface": POINTS})
    assert file.finished == indices.start
    for index in indices:
        file.append(frame(index))
        file.write_checkpoint(saved(index))


def saved(index: int) -> Checkpoint:
    """Return the checkpoint of a frame."""
    rows = {"q": positions(index, NODES), "q_previous": positions(index - 1, NODES)}
    return Checkpoint(index, rows)


def places(file: h5py.File) -> Iterator[tuple[int, int]]:
    """Return the byte offsets of the chunks of frames and checkpoints."""
    for group in ("frames", "checkpoint"):
        for dataset in (file[group][name] for name in file[group] if f"{group}/{name}" in FIELDS):
            for number in range(dataset.id.get_num_chunks()):
                chunk = dataset.id.get_chunk_info(number)
                yield chunk.byte_offset, chunk.byte_offset + chunk.size


class Disk(io.BytesIO):
    """A file that remembers every change of itself, in order."""

    def __init__(self):
        super().__init__()
        # (offset, bytes), or the length to which the file was cut or extended
        self.log = []

    def replace_file(self, monkeypatch):
        monkeypatch.setattr(writer, "open_to_write", self.opened)
        monkeypatch.setattr(os, "pwrite", self.place)

    def opened(self, _, mode):
        return h5py.File(self, mode, libver="earliest", rdcc_nbytes=0)

    def write(self, data):
        self.log.append((self.tell(), bytes(data)))
        return super().write(data)

    def place(self, _, data, offset):
        here = self.tell()
        self.seek(offset)
        self.write(data)
        self.seek(here)
        return len(data)

    def truncate(self, size=None):
        self.log.append(size)
        here = self.tell()
        missing = size - self.seek(0, io.SEEK_END)
        super().write(bytes(max(0, missing)))
        self.seek(here)
        return super().truncate(size)

    def images(self, start, begin=b""):
        """Yield (number of changes made, content) after each change from the start-th on."""
        image = bytearray(begin)
        for number, change in enumerate(self.log, 1):
            end = change if isinstance(change, int) else change[0] + len(change[1])
            image.extend(bytes(max(0, end - len(image))))
            if isinstance(change, int):
                del image[change:]
            else:
                image[change[0] : end] = change[1]
            if number >= start:
                yield number, bytes(image)


def test_ended_early_it_has_its_finished_frames(tmp_path):
    with suppress(RuntimeError), ResultFile(tmp_path / "x.h5", MPI.COMM_SELF, {}) as file:
        write_frames(file, range(4))
        raise RuntimeError
    with open_result(tmp_path / "x.h5") as file:
        assert finished(file) == 4
        assert_holds(file, 4)


def test_planned_frames_take_no_disk_until_written(tmp_path):
    with ResultFile(tmp_path / "x.h5", MPI.COMM_SELF, {}) as file:
        file.start_frames(100, 10_000)
        assert os.stat(file.path).st_size > 100 * 10_000 * 24
        assert os.stat(file.path).st_blocks * 512 < 200_000


def test_replaced_only_when_told_and_only_by_a_new_one(tmp_path):
    path = tmp_path / "x.h5"
    with ResultFile(path, MPI.COMM_SELF, {}) as file:
        write_frames(file, range(3))
    with pytest.raises(InputError, match=r"x\.h5 exists: --overwrite replaces it"):
        ResultFile(path, MPI.COMM_SELF, {})
    with ResultFile(path, MPI.COMM_SELF, {}, Begin.OVERWRITE):
        # the run ended before its first frame
        pass
    with open_result(path) as file:
        assert finished(file) == 3
    with ResultFile(path, MPI.COMM_SELF, {}, Begin.OVERWRITE) as file:
        file.start_frames(1, NODES)
    with open_result(path) as file:
        assert finished(file) == 0 and "surface" not in file["frames"]
    assert os.listdir(tmp_path) == ["x.h5"]


@pytest.mark.parametrize("loss", ["deleted", "moved", "replaced"])
def test_a_file_that_loses_its_name_ends_the_run(tmp_path, loss: str):
    path, moved = tmp_path / "x.h5", tmp_path / "moved.h5"
    with (
        pytest.raises(InputError, match=r"x\.h5 was deleted, moved or replaced during the run"),
        ResultFile(path, MPI.COMM_SELF, {}) as file,
    ):
        write_frames(file, range(3))
        path.rename(moved)
        if loss == "deleted":
            moved.unlink()
        if loss == "replaced":
            path.write_text("of someone else")
        file.write_checkpoint(saved(3))
    assert not list(tmp_path.glob(".*")), "the lock is left"
    if loss == "moved":
        with open_result(moved) as kept:
            assert_holds(kept, 3)
            assert newest_checkpoint(kept)[0] == 2
    if loss == "replaced":
        assert path.read_text() == "of someone else"


def test_refused_on_all_ranks_together(tmp_path):
    path = tmp_path / "x.h5"
    with ResultFile(path, MPI.COMM_SELF, {}) as file:
        write_frames(file, range(1))
    refused = f"refused: {path} exists: --overwrite replaces it\n"
    assert run_on_ranks(2, "refuse", path) == refused * 2
    # the folder is a file
    assert run_on_ranks(2, "refuse", path / "y.h5").count("cannot be written: ") == 2


@pytest.mark.parametrize("action", ["full", "full for one"])
def test_full_disk_stops_all_ranks_with_one_line_and_keeps_the_frames(tmp_path, action):
    path = tmp_path / "x.h5"
    refused = f"refused: {path} cannot be written: No space left on device\n"
    assert run_on_ranks(3, action, path) == refused * 3
    with open_result(path) as file:
        # the file is unchanged, so that a run can continue
        assert finished(file) == 2 and len(file["frames/position"]) == STEPS + 1
        assert_holds(file, 2, surface=False)


def test_too_small_a_disk_is_told_before_the_first_frame(tmp_path):
    small = pytest.raises(InputError, match=r"will need .* GB, and only .* GB are free")
    with small, ResultFile(tmp_path / "x.h5", MPI.COMM_SELF, {}) as file:
        file.start_frames(10**6, 10**7)
    assert os.listdir(tmp_path) == []
