"""Write the result file (HDF5, format_version 1): a single file of all ranks, safe against a kill.

results.layout creates all metadata before the first frame. The data of a frame are written before
its time, and a frame is finished if its time is finite. A new checkpoint overwrites the older of
two slots, whose step is -1 meanwhile, so the other slot always holds a complete checkpoint.

A resumed run writes into the existing file if all datasets that it needs are laid out there.
Otherwise it writes a new file, copies the frames to it, and renames it (`Begin`).
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
    is_named,
    plain_errors,
    refuse_existing,
    refuse_small_disk,
    unlink_inode,
)
from msmpetsc.results.layout import (
    Layout,
    chunk_offsets,
    gather_rows,
    is_distributed,
    number_places,
    open_on_all_ranks,
    open_to_write,
    write_bytes,
)
from msmpetsc.results.reader import Result
from msmpetsc.results.untrusted_file import (
    FORMAT,
    FORMAT_VERSION,
    checked_dataset,
    finished,
    open_result,
)

# surfaces of ranks other than rank 0
EMPTY_SURFACE = Surface(np.empty((0, 3)), np.empty((0, 3), np.int64))


class Begin(Enum):
    """How the writing of a result file begins."""

    NEW = "write a new file, whose name must be free"
    OVERWRITE = "write a new file, which may replace an existing file"
    IN_PLACE = "write into an existing file, in which everything is laid out already"
    COPY = (
        "copy an existing file's frames and a checkpoint to a new file, then replace the old file"
    )


class ResultFile:
    """The result file of a run. All ranks call every method together and raise errors together.

    Until `start_frames` the file has a temporary name. If it is closed before, it is deleted, and
    an existing file of its name stays. If the file system has locks, a lock prevents a second run
    from writing the file at the same time. Write errors (full disk, no permission) raise
    InputError.

    finished : number of finished frames in the file
    """

    def __init__(
        self,
        path: str | Path,
        comm: MPI.Comm,
        attributes: dict[str, Any],
        begin: Begin = Begin.NEW,
    ):
        """Open the file (collective).

        attributes : origin of the file; format and format_version are added
        begin      : whether the file is new, a copy, or written in place

        Raises InputError if the file cannot be written, exists, or is locked.
        """
        self.path = Path(path)
        self.finished = 0
        self._part = self.path.with_name(f"{self.path.name}.{os.getpid()}.part")
        self._comm = comm
        self._begin = begin
        # the file and its storage, on rank 0 only
        self._file: h5py.File | None = None
        self._storage: Storage | None = None
        # type and first byte of fields of frames that are not distributed, on rank 0,
        # time last; set by start_frames
        self._numbers: dict[str, tuple[np.dtype[Any], int]] = {}
        # descriptor of the file on each rank, set by start_frames if all ranks reach it
        self._descriptor: int | None = None
        # lock, temporary name and storage on rank 0, to be released
        self._resources = ExitStack()
        # number of rows of each rank, by the name of a distributed field
        self._rows: dict[str, list[int]] = {}
        # inodes of the lock and the temporary file, by path
        self._temporary: dict[Path, int] = {}
        with self._together():
            if comm.rank == 0:
                self._open(attributes)
        self._temporary = comm.bcast(self._temporary)

    def __enter__(self) -> "ResultFile":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: object
    ) -> None:
        if kind is None:
            self.close()
        else:
            # no collective call here, because other ranks may be elsewhere
            with suppress(InputError), plain_errors(self.path):
                self._finish()
            if not getattr(error, "on_all_ranks", False):
                self.abandon()

    def abandon(self) -> None:
        """Remove the lock and the temporary file before MPI_Abort ends rank 0; not collective."""
        for path, inode in self._temporary.items():
            unlink_inode(path, inode)

    def write(self, name: str, rows: Array) -> None:
        """Store the rows (n_local, ...) of all ranks, one after another, in a dataset (collective).

        name : of the dataset, "lattice/nodes"; a file written in place has the dataset already

        Raises InputError if the existing dataset has another shape.
        """
        rows = np.asarray(rows)
        counts, dtypes = zip(*self._comm.allgather((len(rows), rows.dtype)), strict=True)
        dtype = np.result_type(*dtypes)
        shape = (sum(counts), *rows.shape[1:])
        with self._together():
            if self._file is not None and self._begin is Begin.IN_PLACE:
                stored = checked_dataset(self.path, self._file, name).shape
                if stored != shape:
                    raise InputError(f"{self.path} is damaged: {name} has shape {stored}")
            elif self._file is not None:
                self._file.create_dataset(name, shape, dtype).attrs["units"] = unit_of(name)
        if self._begin is not Begin.IN_PLACE:
            self._collect(rows, dtype, counts, name)

    def start_frames(
        self,
        count: int,
        nodes: int,
        optional: Mapping[str, int] | None = None,
        saved: Checkpoint | None = None,
        kept: int | None = None,
    ) -> None:
        """Lay out frames and checkpoints, and give the file its name (collective).

        count    : number of frames, frame 0 included
        nodes    : number of this rank's nodes
        optional : number of this rank's rows in the optional fields, by name: {"surface": 1000}
        saved    : checkpoint with the rows and numbers to lay out; None for q and q_previous only
        kept     : largest number of frames to copy from the earlier file; None for all
        """
        rows_of_ranks = self._comm.allgather({"position": nodes, **(optional or {})})
        counts = {name: [rank[name] for rank in rows_of_ranks] for name in rows_of_ranks[0]}
        self._rows = {name: counts[name] for name in counts if is_distributed(name)}
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
                self._lay_out(self._file, layout, kept)
        self.finished = self._comm.bcast(self.finished)
        if self._begin is Begin.COPY and saved is not None:
            self.write_checkpoint(saved)
        with self._together():
            if self._file is not None:
                if self._begin is not Begin.IN_PLACE:
                    self._flush(self._file)
                    refuse_existing(self.path, self._begin is not Begin.NEW)
                    os.replace(self._part, self.path)
                self._numbers = number_places(self._file["frames"])
        self._descriptor = open_on_all_ranks(self._comm, self.path)

    def append(self, frame: Frame) -> None:
        """Store the next frame (collective). After the return a kill cannot lose it."""
        index = self.finished
        for name, counts in self._rows.items():
            dtype = np.dtype(FRAME_FIELDS[name].dtype)
            self._collect(getattr(frame, name), dtype, counts, f"frames/{name}", index)
        with self._together():
            if self._file is not None and self._storage is not None:
                self._flush(self._file)
                for name, (dtype, start) in self._numbers.items():
                    numbers = np.ascontiguousarray(getattr(frame, name), dtype)
                    offset = start + index * numbers.nbytes
                    write_bytes(self._storage.fileno(), numbers[None], 0, 1, [offset])
        self.finished += 1

    def write_checkpoint(self, saved: Checkpoint) -> None:
        """Store a checkpoint, with the rows and numbers laid out by `start_frames` (collective).

        Raises InputError if the file was deleted, moved or replaced since `start_frames`.
        """
        slot = 0
        with self._together():
            if self._file is not None:
                self._refuse_lost_name()
                slot = int(np.argmin(self._file["checkpoint/step"]))
                self._file["checkpoint/step"][slot] = -1
                self._flush(self._file)
        slot = self._comm.bcast(slot)
        counts = self._rows["position"]
        for name, values in saved.rows.items():
            self._collect(values, np.dtype("f8"), counts, f"checkpoint/{name}", slot)
        with self._together():
            if self._file is not None:
                if saved.numbers:
                    numbers = [float(value) for value in saved.numbers.values()]
                    self._file["checkpoint/numbers"][slot] = numbers
                self._flush(self._file)
                self._file["checkpoint/step"][slot] = saved.step
                self._flush(self._file)

    def close(self) -> None:
        """Close the file (collective); a second call does nothing."""
        with self._together():
            self._finish()
        self._temporary = {}

    # On rank 0 alone

    def _open(self, attributes: dict[str, Any]) -> None:
        """Take the lock and open the file: the existing file in place, or a new temporary file."""
        refuse_existing(self.path, self._begin is not Begin.NEW)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with ExitStack() as opened:
            lock = Lock(self.path)
            opened.callback(lock.close)
            opened.callback(self._part.unlink, missing_ok=True)
            if self._begin is Begin.IN_PLACE:
                open_result(self.path).close()
                self._storage = Storage(self.path, "r+")
                self._file = open_to_write(self._storage, "r+")
            else:
                self._storage = Storage(self._part, "w+")
                self._file = open_to_write(self._storage, "w")
                own = {"format": FORMAT, "format_version": FORMAT_VERSION}
                self._file.attrs.update(attributes | own)
                self._temporary[self._part] = self._part.stat().st_ino
            opened.callback(self._storage.close)
            self._temporary[lock.path] = lock.inode
            self._resources = opened.pop_all()

    def _flush(self, file: h5py.File) -> None:
        """Flush the file. Raises OSError for an earlier write error."""
        file.flush()
        if self._storage is not None and self._storage.failure is not None:
            raise self._storage.failure

    def _refuse_lost_name(self) -> None:
        """Raise InputError if the path names no file or another file than is written."""
        # before `start_frames` ends, the file has its temporary name
        storage = self._storage if self._numbers else None
        if storage and not is_named(storage.fileno(), self.path):
            raise InputError(
                f"{self.path} was deleted, moved or replaced during the run: "
                "--resume continues a moved file"
            )

    def _lay_out(self, file: h5py.File, layout: Layout, kept: int | None) -> None:
        """Create the datasets, or check the existing datasets of a file written in place.

        Raises InputError if the disk is too small, or an existing dataset does not fit.
        """
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
            self._copy_frames(file, kept)

    def _copy_frames(self, file: h5py.File, kept: int | None) -> None:
        """Copy the finished frames of the earlier file, at most ``kept`` unless it is None."""
        with Result(self.path) as earlier:
            known = [name for name in earlier.frames if name in file["frames"]]
            datasets = {name: file["frames"][name] for name in known}
            for name, dataset in datasets.items():
                shape = earlier.frames[name].shape
                if dataset.shape[1:] != shape[1:]:
                    raise InputError(f"{self.path} is damaged: frames/{name} has shape {shape}")
            count = len(earlier.frames.time[:kept])
            for name, dataset in datasets.items():
                # fields of nodes or points may be too large for the memory
                step = 1 if is_distributed(name) else max(count, 1)
                for first in range(0, count, step):
                    rows = slice(first, first + step)
                    dataset[rows] = earlier.frames[name][rows]
        self.finished = count

    def _finish(self) -> None:
        """Close the file and release its lock."""
        if self._descriptor is not None:
            os.close(self._descriptor)
        self._descriptor = None
        file = self._file
        self._file = None
        self._numbers = {}
        if file is not None:
            with self._resources:
                file.close()

    # On all ranks together

    @contextmanager
    def _together(self) -> Iterator[None]:
        """Raise an error of any rank on all ranks after the block (collective)."""
        reporting = self._storage.reporting_errors() if self._storage else nullcontext()
        with together(self._comm), plain_errors(self.path), reporting:
            yield

    def _collect(
        self,
        rows: Array,
        dtype: np.dtype[Any],
        counts: Sequence[int],
        name: str,
        index: int | None = None,
    ) -> None:
        """Write the ranks' rows, `counts` each, to a dataset or its row `index` (collective)."""
        rows = np.ascontiguousarray(rows, dtype)
        if self._descriptor is not None and index is not None:
            self._write_directly(self._descriptor, rows, counts, name, index)
            return
        # on rank 0, the only rank that stores
        file: Any = self._file

        def store(part: slice, piece: Array) -> None:
            file[name][part if index is None else (index, part)] = piece

        with self._together():
            gather_rows(self._comm, rows, counts, store)

    def _write_directly(
        self, descriptor: int, rows: Array, counts: Sequence[int], name: str, index: int
    ) -> None:
        """Write each rank's rows to their bytes in row `index` of dataset `name` (collective)."""
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
    lattice, owned = model.lattice.with_springs(), model.lattice.owned
    springs = slice(lattice.springs_owned)
    numbers = lattice.global_numbers
    file.write("lattice/nodes", lattice.nodes[:owned])
    file.write("lattice/cells", lattice.cells)
    file.write("lattice/cell_kind", lattice.cell_kind)
    file.write("lattice/cell_share", lattice.cell_fill)
    file.write("lattice/springs", numbers[lattice.springs[springs]])
    file.write("lattice/rest_length", lattice.rest_length[springs])
    file.write("lattice/stiffness", lattice.stiffness[springs])
    file.write("lattice/mass", lattice.mass)
    file.write("lattice/pinned", numbers[:owned][lattice.pinned[:owned]])
    several = len(model.bodies) > 1
    if several:
        file.write("lattice/body", lattice.body[:owned].astype("i4"))
    # rank 0 has all solids
    if comm.bcast(bool(model.solids)):
        solids = joined([*model.solids.values()]) or EMPTY_SURFACE
        counts = [len(solid.triangles) for solid in model.solids.values()]
        file.write("obstacle/points", solids.points)
        file.write("obstacle/triangles", solids.triangles)
        file.write("obstacle/number", np.repeat(np.array([*model.solids], "i4"), counts))
    surface, embedding = model.surface or EMPTY_SURFACE, model.embedding
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
