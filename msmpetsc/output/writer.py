"""The result file (HDF5, format_version 1): one file of all ranks, safe against a kill.

Rank 0 has it open. It writes the rows of all ranks, in pieces; of frames and checkpoints each rank writes its own
where it can reach the file (output.direct). The file is the same.

All metadata is on disk before the first frame and does not change while frames are written: every dataset of
``/frames`` and ``/checkpoint`` has its planned length from the start, its chunks allocated, nothing buffered.
A frame is its data and, after them, its time. ``/frames/time`` starts as NaN: a frame is there when its time is
finite (`finished`). So a process killed at any moment leaves a file that opens and holds every finished frame.

``/checkpoint`` has two slots: ``step (2,)``, ``q (2,n,3)``, ``q_previous (2,n,3)``, and what else the run goes on from,
``numbers (2,k)`` with their names as an attribute and rows of nodes (2,n,...). The older slot is written, with its
step at -1 meanwhile, so a whole checkpoint is always left: the slot of the greatest step.

A run that goes on (output.continued) writes into the file as it lies there, if all that it needs is laid out in it: so no
metadata change then either. Else it writes a new one, takes the frames over, and renames it when it holds them.
"""

import fcntl
import math
import os
import re
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from errno import EACCES, EAGAIN
from pathlib import Path

import h5py
import numpy as np

from msmpetsc.comm import together
from msmpetsc.errors import InputError
from msmpetsc.model.checkpoint import Checkpoint
from msmpetsc.model.frame import Frame
from msmpetsc.output.direct import chunk_places, reach, write_rows
from msmpetsc.output.reader import FORMAT, FORMAT_VERSION, finished, open_result, read_checkpoint  # noqa: F401

PIECE_BYTES = 64 * 2**20  # the most that rank 0 holds of another rank's rows
CHUNK_BYTES = 64 * 2**20
STATIC_UNITS = {
    "lattice/nodes": "m",
    "lattice/rest_length": "m",
    "lattice/stiffness": "N/m",
    "lattice/mass": "kg",
    "surface/points": "m",
}
CHECKPOINT_UNITS = {
    "checkpoint/contact_bound": "N/m",
    "checkpoint/history_v": "m/s",
    "checkpoint/mode": "1",
    "checkpoint/lowest_mode": "kg^-1/2",
    "checkpoint/sides": "1",
}
# The numbers of a frame, named as in Frame and in /frames: dtype, shape, unit.
SERIES = {
    "time": ("f8", (), "s"),
    "step_error": ("f8", (), "1"),
    "iterations": ("i8", (), "1"),
    "ksp_its": ("i8", (), "1"),
    "kinetic": ("f8", (), "J"),
    "elastic": ("f8", (), "J"),
    "potential": ("f8", (), "J"),
    "contact": ("f8", (), "J"),
    "momentum": ("f8", (3,), "kg m/s"),
    "wall_time": ("f8", (), "s"),
    "true_error": ("f8", (), "1"),
    "energy_error": ("f8", (), "1"),
    "inverted": ("i8", (), "1"),
    "substeps": ("i8", (), "1"),
    "fallbacks": ("i8", (), "1"),
    "energy_gained": ("f8", (), "J"),
}


class ResultFile:
    """The result file of one run. Every rank of `comm` calls every method; errors are raised on all together.

    The file has a temporary name until `start_frames`; closed before that, it is dropped, and an old file of its
    name stays. What cannot be written (full disk, no permission) raises InputError. A lock beside the file, where the
    file system has locks, keeps a second run from writing it at the same time.

    finished : number of frames that it holds
    gathers  : rank 0 writes frames for all ranks, even where each can reach the file; to be said before they start
    """

    gathers = False

    def __init__(self, path: str | Path, comm, attributes: dict, overwrite: bool = False):
        """comm: an mpi4py communicator. attributes: see design.md; format and format_version are added here."""
        self.path = Path(path)
        self._part = self.path.with_name(f"{self.path.name}.{os.getpid()}.part")
        self._comm = comm
        self._overwrite = overwrite
        self._file: h5py.File | None = None  # open on rank 0 only
        self._direct: int | None = None  # descriptor of the same file on each rank, once it has its name
        self._same: int | None = None  # another one on rank 0, to read what it holds when it has no name any more
        self._lock: Lock | None = None  # held on rank 0 only
        self._planned = self.finished = 0
        self._failed = False  # to write
        with self._together():
            if comm.rank == 0:
                self._open(attributes)

    def __enter__(self) -> "ResultFile":
        return self

    def __exit__(self, kind, *_) -> None:
        if kind is None:
            self.close()
        else:  # no word to the other ranks, which may be elsewhere; the first error is the one to tell
            with suppress(InputError), plain_errors(self.path):
                self._finish(trim=not self._failed)  # a full disk is no place to change metadata

    def write(self, name: str, rows: np.ndarray) -> None:
        """Store the ranks' rows, (n_local, ...) on each, one after the other as dataset `name`: "lattice/nodes"."""
        rows = np.asarray(rows)
        counts, shapes, dtypes = zip(*self._comm.allgather((len(rows), rows.shape[1:], rows.dtype)))
        if len(set(shapes)) > 1:
            raise ValueError(f"{name}: the ranks' rows differ in shape: {set(shapes)}")
        dtype = np.result_type(*dtypes)
        with self._together():
            if self._file is not None:
                dataset = self._file.create_dataset(name, (sum(counts), *shapes[0]), dtype)
                dataset.attrs["unit"] = STATIC_UNITS.get(name, "1")
        self._collect(rows, dtype, counts, name)

    def start_frames(
        self,
        count: int,
        nodes: int,
        surface_points: int | None = None,
        surface_dtype: str = "f4",
        saved: Checkpoint | None = None,
    ) -> None:
        """Plan `count` frames, frame 0 included, of this rank's `nodes` and `surface_points` (None: not stored), and
        checkpoints like this one; of q and q_previous alone if None."""
        self._nodes, self._points = zip(*self._comm.allgather((nodes, surface_points)))
        self._surface_dtype = surface_dtype
        self._rows = {"q": (3,), "q_previous": (3,)}
        if saved:
            self._rows |= {name: rows.shape[1:] for name, rows in saved.rows.items()}
        self._numbers = list(saved.numbers) if saved else []
        with self._together():
            if self._file is not None:
                self._start(count)
        self.finished, self._planned = self._comm.bcast(self.finished), count
        self._take_over(saved)
        with self._together():
            if self._file is not None:
                self._publish()
                self._same = os.open(self.path, os.O_RDONLY)
        if self._comm.size > 1 and not self.gathers:
            self._direct = reach(self._comm, self.path)

    def append(self, frame: Frame) -> None:
        """Store the next frame; once this returns, no kill can lose it."""
        self._check(frame)
        here = self.finished
        self._collect(frame.position, "f8", self._nodes, "frames/position", here)
        if self._points[0] is not None:
            self._collect(frame.surface, self._surface_dtype, self._points, "frames/surface", here)
        with self._together():
            if self._file is not None:
                frames = self._file["frames"]
                for name in SERIES.keys() - {"time"}:
                    frames[name][here] = getattr(frame, name)
                self._file.flush()
                frames["time"][here] = frame.time  # from here on the frame is there
                self._file.flush()
        self.finished += 1

    def write_checkpoint(self, saved: Checkpoint) -> None:
        """Store what the run can go on from; rows and numbers named as those that were planned."""
        if (saved.rows.keys(), list(saved.numbers)) != (self._rows.keys(), self._numbers):
            raise ValueError(f"planned were checkpoints of {list(self._rows)} and {self._numbers}")
        for name, rows in saved.rows.items():
            self._check_rows(name, rows, self._nodes, self._rows[name])
        slot = None
        with self._together():
            if self._file is not None:
                slot = int(np.argmin(self._file["checkpoint/step"]))
                self._file["checkpoint/step"][slot] = -1
                self._file.flush()
        slot = self._comm.bcast(slot)
        for name, rows in saved.rows.items():
            self._collect(rows, "f8", self._nodes, f"checkpoint/{name}", slot)
        with self._together():
            if self._file is not None:
                if self._numbers:
                    self._file["checkpoint/numbers"][slot] = [float(value) for value in saved.numbers.values()]
                self._file.flush()
                self._file["checkpoint/step"][slot] = saved.step
                self._file.flush()
                self._refuse_removed()

    def close(self, trim: bool = True) -> None:
        """Close, a second call does nothing. Before, trim the frames to the finished ones, but where the run is to go
        on: as it lies there the file has room for the rest."""
        with self._together():
            self._finish(trim)

    # On rank 0 alone

    def _open(self, attributes: dict) -> None:
        self._refuse_to_replace()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._lock = Lock(self.path)
        self._create(attributes)

    def _create(self, attributes: dict) -> None:
        try:
            self._file = open_new(self._part)
            self._file.attrs.update(attributes | {"format": FORMAT, "format_version": FORMAT_VERSION})
        except Exception:
            self._part.unlink(missing_ok=True)
            self._lock.free()
            raise

    def _refuse_to_replace(self) -> None:
        if self.path.is_dir():
            raise InputError(f"{self.path} is a folder, not a file")
        if self.path.exists() and not self.path.is_file():
            raise InputError(f"{self.path} is a pipe or a device, not a file")
        if self.path.exists() and not self._overwrite:
            raise InputError(f"{self.path} exists: --overwrite replaces it")

    def _layout(self, count: int) -> list[tuple]:
        return _layout(count, sum(self._nodes), self._points, self._surface_dtype, self._rows, len(self._numbers))

    def _start(self, count: int) -> None:
        datasets = self._layout(count)
        planned = sum(math.prod(shape) * np.dtype(dtype).itemsize for _, shape, _, dtype, _ in datasets)
        refuse_small_disk(self.path, planned - _given_back(self.path))
        for name in ("frames", "checkpoint"):
            self._file.create_group(name)
        for dataset in datasets:
            _plan_dataset(self._file, *dataset)
        self._file["frames/time"][...] = np.nan
        self._file["checkpoint/step"][...] = -1
        if self._numbers:
            self._file["checkpoint/numbers"].attrs["names"] = " ".join(self._numbers)

    def _publish(self) -> None:
        self._file.flush()
        self._refuse_to_replace()
        os.replace(self._part, self.path)

    def _refuse_removed(self) -> None:
        """Raise InputError where no name leads to the file any more; what it holds gets one again."""
        if self._same is None or os.fstat(self._same).st_nlink:
            return
        copy = self.path.with_name(f"{self.path.stem}.{os.getpid()}{self.path.suffix}")
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy_sparse(self._same, copy)
        if not self.path.exists():
            copy = copy.rename(self.path)
        command = f"msmpetsc run --resume {shlex.quote(str(copy))}"
        raise InputError(
            f"{self.path} was removed while it was written; what it held is in {copy}, to go on: {command}"
        )

    def _finish(self, trim: bool) -> None:
        for descriptor in (self._direct, self._same):
            if descriptor is not None:
                os.close(descriptor)
        self._direct = self._same = None
        file, self._file = self._file, None
        if file is None:
            return
        self._part.unlink(missing_ok=True)  # still there only if no frames were started
        try:
            with file:
                if trim and self.finished < self._planned:
                    for dataset in file["frames"].values():
                        dataset.resize(self.finished, axis=0)
        finally:
            self._lock.free()

    # What the ranks do together

    @contextmanager
    def _together(self) -> Iterator[None]:
        """What one rank cannot do in the block, all raise after it."""
        try:
            with together(self._comm), plain_errors(self.path):
                yield
        except InputError:
            self._failed = True
            raise

    def _take_over(self, _: Checkpoint | None) -> None:
        """Nothing was there before."""

    def _check(self, frame: Frame) -> None:
        if self.finished >= self._planned:
            raise ValueError(f"frame {self.finished} was not planned: {self._planned} frames were")
        if not np.isfinite(frame.time):
            raise ValueError(f"frame {self.finished} has time {frame.time}")
        self._check_rows("position", frame.position, self._nodes)
        if self._points[0] is not None:
            self._check_rows("surface", frame.surface, self._points)

    def _check_rows(
        self, name: str, rows: np.ndarray | None, counts: Sequence[int], shape: tuple[int, ...] = (3,)
    ) -> None:
        planned = (counts[self._comm.rank], *shape)
        if np.shape(rows) != planned:
            raise ValueError(f"{name} has shape {np.shape(rows)} on rank {self._comm.rank}, planned were {planned}")

    def _collect(self, rows: np.ndarray, dtype, counts: Sequence[int], name: str, index: int | None = None) -> None:
        """Write the ranks' rows, `counts` of them, into dataset `name`, at its row `index` if given."""
        rows = np.ascontiguousarray(rows, dtype)
        if self._direct is not None and index is not None:
            self._write_directly(rows, counts, name, index)
            return

        def store(start: int, piece: np.ndarray) -> None:
            part = slice(start, start + len(piece))
            self._file[name][part if index is None else (index, part)] = piece

        with self._together():
            if self._comm.rank > 0:
                for part in pieces(rows, len(rows)):
                    self._comm.Send(rows[part], dest=0)
            else:
                _receive(self._comm, rows, counts, store)

    def _write_directly(self, rows: np.ndarray, counts: Sequence[int], name: str, index: int) -> None:
        chunk, places = 0, []
        with self._together():
            if self._file is not None:
                dataset = self._file[name]
                chunk, places = dataset.chunks[1], chunk_places(dataset, index)
        chunk, places = self._comm.bcast((chunk, places))
        with self._together():
            write_rows(self._direct, rows, sum(counts[: self._comm.rank]), chunk, places)


def _receive(comm, rows: np.ndarray, counts: Sequence[int], store: Callable[[int, np.ndarray], None]) -> None:
    """Hand store(start, piece) this rank's rows, then the pieces that the other ranks send."""
    start, failure = 0, None
    for rank, count in enumerate(counts):
        for part in pieces(rows, count):
            piece = rows[part]
            if rank > 0:
                piece = np.empty((part.stop - part.start, *rows.shape[1:]), rows.dtype)
                comm.Recv(piece, source=rank)
            try:
                if failure is None and len(piece):
                    store(start + part.start, piece)
            except OSError as error:
                failure = error  # the others still send: hear them out
        start += count
    if failure is not None:
        raise failure


def pieces(rows: np.ndarray, count: int) -> Iterator[slice]:
    """Parts of `count` rows like these, of at most PIECE_BYTES each."""
    row_bytes = rows.dtype.itemsize * math.prod(rows.shape[1:])
    most = max(1, PIECE_BYTES // row_bytes)
    return (slice(start, min(start + most, count)) for start in range(0, count, most))


def open_new(path: Path) -> h5py.File:
    """An empty file, of a kind that a kill cannot spoil.

    libver earliest: its superblock has no flag "open for writing", which would shut a killed run's file. No chunk
    cache: nothing waits to be written. No lock: a running result may be looked at.
    """
    return h5py.File(path, "w", libver="earliest", rdcc_nbytes=0, locking=False)


def open_again(path: Path) -> h5py.File:
    """A file of that kind, to be written further."""
    return h5py.File(path, "r+", libver="earliest", rdcc_nbytes=0, locking=False)


def _layout(
    count: int,
    nodes: int,
    points: Sequence[int | None],
    surface_dtype: str,
    kept: Mapping[str, tuple[int, ...]],
    kept_numbers: int,
) -> list[tuple]:
    """Name, shape, chunks, dtype and unit of each dataset that is written frame by frame, in this order.

    kept, kept_numbers : shapes of a node's part of the checkpoint's rows; how many numbers it has
    """

    def positions(name: str, times: int, rows: int, dtype: str, shape: tuple[int, ...] = (3,)) -> tuple:
        most = CHUNK_BYTES // (math.prod(shape) * np.dtype(dtype).itemsize)
        return name, (times, rows, *shape), (1, min(max(1, rows), most), *shape), dtype, CHECKPOINT_UNITS.get(name, "m")

    numbers = [
        (f"frames/{name}", (count, *shape), (count, *shape), dtype, unit)
        for name, (dtype, shape, unit) in SERIES.items()
    ]
    surface = [] if points[0] is None else [positions("frames/surface", count, sum(points), surface_dtype)]
    # The checkpoint comes last: it is never trimmed, so the end of the file never moves back. (HDF5 would cut the
    # file before noting its new length; killed in between, it could not be opened.)
    return [
        *numbers,
        positions("frames/position", count, nodes, "f8"),
        *surface,
        ("checkpoint/step", (2,), (2,), "i8", "1"),
        *([("checkpoint/numbers", (2, kept_numbers), (1, kept_numbers), "f8", "1")] if kept_numbers else []),
        *(positions(f"checkpoint/{name}", 2, nodes, "f8", shape) for name, shape in kept.items()),
    ]


def _plan_dataset(file: h5py.File, name: str, shape: tuple, chunks: tuple, dtype: str, unit: str) -> None:
    """A dataset that can shrink, with all its place in the file set aside now and nothing written there.

    Through h5py's lower layer: its create_dataset insists on filling datasets that can change their size.
    """
    dcpl = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    dcpl.set_chunk(chunks)
    dcpl.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    dcpl.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    dcpl.set_obj_track_times(False)  # the same run makes the same bytes
    if name == "frames/time":
        dcpl.set_fill_value(np.array(np.nan))  # what shrinking puts behind the new end
    space, kind = h5py.h5s.create_simple(shape, shape), h5py.h5t.py_create(np.dtype(dtype))
    h5py.h5d.create(file.id, name.encode(), kind, space, dcpl)
    file[name].attrs["unit"] = unit


def _given_back(path: Path) -> int:
    """[byte] that the file there takes, which is to be replaced."""
    return path.stat().st_blocks * 512 if path.exists() else 0


class Lock:
    """Held on a file beside ``path`` while that is written; taken from a run that is killed by the system itself."""

    def __init__(self, path: Path):
        """Raises InputError where another run has it."""
        self.path = path.with_name(f".{path.name}.lock")
        while not self._take(path):
            pass

    def _take(self, path: Path) -> bool:
        """False where the run that had it took its name away before it was locked: another may lock a new one by now."""
        self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
        try:
            fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (EACCES, EAGAIN):  # else it is a file system without locks
                os.close(self._file)
                raise InputError(f"{path} is being written by another run") from None
            return True
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(self._file), os.stat(self.path)):
                return True
        os.close(self._file)
        return False

    def free(self) -> None:
        self.path.unlink(missing_ok=True)  # while it is locked: the name is still this file's
        os.close(self._file)


def refuse_small_disk(path: Path, planned: int) -> None:
    """Better now than hours later. planned: [byte]."""
    free = shutil.disk_usage(path.parent).free
    if planned > free:
        raise InputError(f"{path} will need {planned / 1e9:.3g} GB, and only {free / 1e9:.3g} GB are free there")


def copy_sparse(source: int, path: Path) -> None:
    """The file of a descriptor under another name; zeros, which frames to come are, take no room."""
    with open(path, "xb") as copy:
        for start in range(0, size := os.fstat(source).st_size, 2**20):
            if (piece := os.pread(source, 2**20, start)).strip(b"\0"):
                os.pwrite(copy.fileno(), piece, start)
        copy.truncate(size)


@contextmanager
def plain_errors(path: Path) -> Iterator[None]:
    """Turn errors of the file system into one line; HDF5 words them at length, and not always as OSError."""
    try:
        yield
    except (OSError, RuntimeError, ValueError) as error:
        told = re.search(r"error message = '([^']*)'", str(error))
        if not told and not isinstance(error, OSError):
            raise
        raise InputError(f"{path} cannot be written: {told[1] if told else error.strerror or error}") from error
