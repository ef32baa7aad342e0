"""Writing of the result file (HDF5, format_version 1): one file of all ranks, safe against a kill.

All metadata is on disk before the first frame and does not change while frames are written (results.layout). A frame is
its data and, after them, its time. ``/frames/time`` starts as NaN: a frame is there when its time is finite
(`finished`). Of the checkpoint's two slots the older is written, with its step at -1 meanwhile, so a whole checkpoint
is always left: the slot of the greatest step.

A run that goes on writes into the file as it lies there, if all that it needs is laid out in it: so no metadata change
then either. Else it writes a new one, takes the frames over, and renames it when it holds them (`Begin`).
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from enum import Enum
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array
from msmpetsc.build import Model
from msmpetsc.checkpoint import Checkpoint
from msmpetsc.comm import together
from msmpetsc.errors import InputError
from msmpetsc.fields import FRAME_FIELDS, Frame, unit_of
from msmpetsc.geometry.surface import Surface, joined
from msmpetsc.results.disk import (
    Lock,
    Storage,
    plain_errors,
    refuse_no_file,
    refuse_small_disk,
    unlink_inode,
)
from msmpetsc.results.layout import (
    Layout,
    chunk_offsets,
    gather_rows,
    of_ranks,
    open_on_all_ranks,
    open_to_write,
    write_bytes,
)
from msmpetsc.results.reader import (
    FORMAT,
    FORMAT_VERSION,
    Result,
    checked_dataset,
    finished,
    open_result,
)

NOTHING = Surface(
    np.empty((0, 3)), np.empty((0, 3), np.int64)
)  # what ranks but the first have of surfaces


class Begin(Enum):
    """How the writing of a result file begins."""

    NEW = "a new file, of a name that is free"
    OVERWRITE = "a new file, which may replace another"
    IN_PLACE = "an earlier file as it lies there, laid out for all frames: only numbers in their places are written"
    COPY = "a new file with the frames of an earlier one, which it replaces when it has them and a checkpoint"


class ResultFile:
    """The result file of one run. Every rank of `comm` calls every method; errors are raised on all together.

    The file has a temporary name until `start_frames`; closed before that, it is dropped, and an old file of its
    name stays. What cannot be written (full disk, no permission) raises InputError. A lock beside the file, where the
    file system has locks, keeps a second run from writing it at the same time.

    finished : number of frames that it holds
    """

    def __init__(
        self,
        path: str | Path,
        comm: MPI.Comm,
        attributes: dict[str, Any],
        begin: Begin = Begin.NEW,
        gathers: bool = False,
    ):
        """Open the file.

        attributes : who makes it and how; format and format_version are added
        gathers    : rank 0 writes frames for all ranks, even where each can reach the file
        """
        self.path = Path(path)
        self._planned = self.finished = 0
        self._part = self.path.with_name(f"{self.path.name}.{os.getpid()}.part")
        self._comm, self._begin, self._gathers = comm, begin, gathers
        self._file: h5py.File | None = None  # open on rank 0 only
        self._storage: Storage | None = None  # that it is written to
        self._numbers: dict[
            str, h5py.Dataset
        ] = {}  # datasets of one number a frame, once it has frames
        self._direct: int | None = (
            None  # descriptor of the same file on each rank, once it has its name
        )
        self._opened = (
            ExitStack()
        )  # on rank 0 the lock, the temporary name and the storage, until they are given up
        self._copied: int | None = None  # most frames to take over, all if None
        self._rows: dict[str, list[int]] = {}  # fields that ranks have rows of: how many each has
        self._failed = False  # to write
        self._passing: dict[
            Path, int
        ] = {}  # inodes of files that last no longer than the run, by name
        with self._together():
            if comm.rank == 0:
                self._open(attributes)
        self._passing = comm.bcast(self._passing)

    def __enter__(self) -> "ResultFile":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: object
    ) -> None:
        if kind is None:
            self.close()
        else:  # no word to the other ranks, which may be elsewhere; the first error is the one to tell
            with suppress(InputError), plain_errors(self.path):
                self._finish(trim=not self._failed)  # a full disk is no place to change metadata
            if not getattr(error, "on_all_ranks", False):
                self.abandon()

    def abandon(self) -> None:
        """Remove the lock and the temporary file, as MPI_Abort is about to end rank 0. Any rank may call it."""
        for path, inode in self._passing.items():
            unlink_inode(path, inode)

    def write(self, name: str, rows: Array) -> None:
        """Store the rows of all ranks, (n_local, ...) on each, in order as dataset `name`: "lattice/nodes".

        A file that begins in place has it; raises InputError where its shape is another.
        """
        rows = np.asarray(rows)
        counts, dtypes = zip(*self._comm.allgather((len(rows), rows.dtype)), strict=True)
        dtype, shape = np.result_type(*dtypes), (sum(counts), *rows.shape[1:])
        with self._together():
            if self._file is not None and self._begin is Begin.IN_PLACE:
                stored = checked_dataset(self.path, self._file, name).shape
                if stored != shape:
                    raise InputError(f"{self.path} is damaged: {name} has shape {stored}")
            elif self._file is not None:
                self._file.create_dataset(name, shape, dtype).attrs["units"] = unit_of(name)
        if self._begin is not Begin.IN_PLACE:
            self._collect(rows, dtype, counts, name)

    def keep(self, frames: int) -> None:
        """Limit the number of frames that are copied from the earlier file."""
        self._copied = frames

    def start_frames(
        self,
        count: int,
        nodes: int,
        also: Mapping[str, int] | None = None,
        saved: Checkpoint | None = None,
    ) -> None:
        """Plan the frames and checkpoints, and give the file its name.

        count : of frames, frame 0 included
        nodes : of this rank
        also  : this rank's rows of fields that not all scenes ask for, by their names: {"surface": 1000}
        saved : a checkpoint like those to come; None: of q and q_previous alone
        """
        given = self._comm.allgather({"position": nodes, **(also or {})})
        counts = {name: [rank[name] for rank in given] for name in given[0]}
        self._rows = {name: counts[name] for name in counts if of_ranks(name)}
        sizes = {
            name: sum(rows) if name in self._rows else rows[0] for name, rows in counts.items()
        }
        rows: dict[str, tuple[int, ...]] = {"q": (3,), "q_previous": (3,)}
        if saved:
            rows |= {name: values.shape[1:] for name, values in saved.rows.items()}
        numbers = tuple(saved.numbers) if saved else ()
        layout = Layout(count, sizes.pop("position"), sizes, rows, numbers)
        with self._together():
            if self._file is not None:
                self._lay_out(self._file, layout)
        self.finished, self._planned = self._comm.bcast(self.finished), count
        if self._begin is Begin.COPY and saved is not None:
            self.write_checkpoint(saved)
        with self._together():
            if self._file is not None:
                if self._begin is not Begin.IN_PLACE:
                    self._flush(self._file)
                    self._refuse_to_replace()
                    os.replace(self._part, self.path)
                self._numbers = {
                    name: dataset
                    for name, dataset in self._file["frames"].items()
                    if name in FRAME_FIELDS and name != "time" and not of_ranks(name)
                }
        if self._comm.size > 1 and not self._gathers:
            self._direct = open_on_all_ranks(self._comm, self.path)

    def append(self, frame: Frame) -> None:
        """Store the next frame, so that no kill can lose it once this returns."""
        index = self.finished
        for name, counts in self._rows.items():
            self._collect(
                getattr(frame, name),
                np.dtype(FRAME_FIELDS[name].dtype),
                counts,
                f"frames/{name}",
                index,
            )
        with self._together():
            if self._file is not None:
                for name, numbers in self._numbers.items():
                    numbers[index] = getattr(frame, name)
                self._flush(self._file)
                self._file["frames/time"][index] = frame.time  # from here on the frame is there
                self._flush(self._file)
        self.finished += 1

    def write_checkpoint(self, saved: Checkpoint) -> None:
        """Store a checkpoint, with the rows and numbers that were planned."""
        slot = 0
        with self._together():
            if self._file is not None:
                slot = int(np.argmin(self._file["checkpoint/step"]))
                self._file["checkpoint/step"][slot] = -1
                self._flush(self._file)
        slot = self._comm.bcast(slot)
        for name, values in saved.rows.items():
            self._collect(
                values, np.dtype("f8"), self._rows["position"], f"checkpoint/{name}", slot
            )
        with self._together():
            if self._file is not None:
                if saved.numbers:
                    self._file["checkpoint/numbers"][slot] = [
                        float(value) for value in saved.numbers.values()
                    ]
                self._flush(self._file)
                self._file["checkpoint/step"][slot] = saved.step
                self._flush(self._file)

    def close(self, trim: bool = True) -> None:
        """Close the file; a second call does nothing.

        Before, trim the frames to the finished ones, but where the run is to go on: as it lies
        there the file has room for the rest.
        """
        with self._together():
            self._finish(trim)
        self._passing = {}

    # On rank 0 alone

    def _open(self, attributes: dict[str, Any]) -> None:
        if self._begin is not Begin.IN_PLACE:
            self._refuse_to_replace()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with ExitStack() as opened:
            lock = Lock(self.path)
            opened.callback(lock.free)
            opened.callback(self._part.unlink, missing_ok=True)
            if self._begin is Begin.IN_PLACE:
                open_result(self.path).close()
                self._storage = Storage(self.path, "r+")
                self._file = open_to_write(self._storage, "r+")
            else:
                self._storage = Storage(self._part, "w+")
                self._file = open_to_write(self._storage, "w")
                self._file.attrs.update(
                    attributes | {"format": FORMAT, "format_version": FORMAT_VERSION}
                )
                self._passing[self._part] = self._part.stat().st_ino
            opened.callback(self._storage.close)
            self._passing[lock.path] = lock.inode
            self._opened = opened.pop_all()

    def _flush(self, file: h5py.File) -> None:
        """Flush the file. Raises OSError for an earlier write error."""
        file.flush()
        if self._storage is not None and self._storage.failure is not None:
            raise self._storage.failure

    def _refuse_to_replace(self) -> None:
        refuse_no_file(self.path)
        if self.path.exists() and self._begin is Begin.NEW:
            raise InputError(f"{self.path} exists: --overwrite replaces it")

    def _lay_out(self, file: h5py.File, layout: Layout) -> None:
        if self._begin is Begin.IN_PLACE:
            if name := layout.first_misfit(file):
                raise InputError(
                    f"{self.path} has no room for {name} as it is now: --force writes the file anew"
                )
            refuse_small_disk(self.path, self.path.stat().st_size)
            self.finished = finished(file)
            return
        refuse_small_disk(self.path, layout.nbytes)
        layout.create(file)
        if self._begin is Begin.COPY:
            self._copy_frames(file)

    def _copy_frames(self, file: h5py.File) -> None:
        """Copy the frames of the earlier file, as many as it has and `keep` allows."""
        with Result(self.path) as earlier:
            datasets = {
                name: file["frames"][name] for name in earlier.frames if name in file["frames"]
            }
            for name, dataset in datasets.items():
                if dataset.shape[1:] != earlier.frames[name].shape[1:]:
                    raise InputError(
                        f"{self.path} is damaged: frames/{name} has shape {earlier.frames[name].shape}"
                    )
            count = len(earlier.frames.time)
            if self._copied is not None:
                count = min(self._copied, count)
            for index in range(count):
                for name, dataset in datasets.items():
                    dataset[index] = earlier.frames[name][index]
        self.finished = count

    def _finish(self, trim: bool) -> None:
        if self._direct is not None:
            os.close(self._direct)
        self._direct = None
        file, self._file, self._numbers = self._file, None, {}
        if file is None:
            return
        with self._opened, file:
            if trim and self.finished < self._planned:
                for name in FRAME_FIELDS.keys() & file["frames"].keys():
                    file["frames"][name].resize(self.finished, axis=0)

    # What the ranks do together

    @contextmanager
    def _together(self) -> Iterator[None]:
        """Raise an error of any rank on all ranks after the block."""
        try:
            telling = self._storage.telling() if self._storage else nullcontext()
            with together(self._comm), plain_errors(self.path), telling:
                yield
        except InputError:
            self._failed = True
            raise

    def _collect(
        self,
        rows: Array,
        dtype: np.dtype[Any],
        counts: Sequence[int],
        name: str,
        index: int | None = None,
    ) -> None:
        """Write the ranks' rows, `counts` of each, into dataset `name`, or into its row `index`."""
        rows = np.ascontiguousarray(rows, dtype)
        if self._direct is not None and index is not None:
            self._write_directly(self._direct, rows, counts, name, index)
            return
        file: Any = self._file  # on rank 0, which alone stores

        def store(part: slice, piece: Array) -> None:
            file[name][part if index is None else (index, part)] = piece

        with self._together():
            gather_rows(self._comm, rows, counts, store)

    def _write_directly(
        self, descriptor: int, rows: Array, counts: Sequence[int], name: str, index: int
    ) -> None:
        chunk, offsets = 0, []
        with self._together():
            if self._file is not None:
                dataset = self._file[name]
                chunk, offsets = dataset.chunks[1], chunk_offsets(dataset, index)
        chunk, offsets = self._comm.bcast((chunk, offsets))
        with self._together():
            write_bytes(descriptor, rows, sum(counts[: self._comm.rank]), chunk, offsets)


def write_model(comm: MPI.Intracomm, file: ResultFile, model: Model) -> None:
    """Write the parts of the file that do not change with time (collective)."""
    lattice, owned = model.lattice, model.lattice.owned
    springs = slice(lattice.springs_owned)
    numbers = lattice.global_numbers
    file.write("lattice/nodes", lattice.nodes[:owned])
    file.write("lattice/cells", lattice.cells)
    file.write("lattice/cell_kind", lattice.cell_kind)
    file.write("lattice/cell_share", lattice.cell_share)
    file.write("lattice/springs", numbers[lattice.springs[springs]])
    file.write("lattice/rest_length", lattice.rest_length[springs])
    file.write("lattice/stiffness", lattice.stiffness[springs])
    file.write("lattice/mass", lattice.mass)
    file.write("lattice/pinned", numbers[:owned][lattice.pinned[:owned]])
    several = len(model.bodies) > 1
    if several:
        file.write("lattice/body", lattice.body[:owned].astype("i4"))
    if comm.bcast(bool(model.solids)):  # all of them on rank 0
        solids = joined([*model.solids.values()]) or NOTHING
        counts = [len(solid.triangles) for solid in model.solids.values()]
        file.write("obstacle/points", solids.points)
        file.write("obstacle/triangles", solids.triangles)
        file.write("obstacle/number", np.repeat(np.array([*model.solids], "i4"), counts))
    surface, embedding = model.surface or NOTHING, model.embedding
    if embedding is None:
        return
    if several:
        file.write("surface/body", model.body_of_point.astype("i4"))
    file.write("surface/points", surface.points)
    file.write("surface/triangles", surface.triangles)
    offset = comm.exscan(len(embedding.indices)) or 0
    indptr = embedding.indptr[1:] + offset
    file.write("embedding/indptr", np.append(0, indptr) if comm.rank == 0 else indptr)
    file.write("embedding/indices", embedding.indices)
    file.write("embedding/weights", embedding.data)
