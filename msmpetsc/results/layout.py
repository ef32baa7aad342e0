"""Lay out a result file, and transfer distributed rows between the file and the ranks.

All metadata is written before the first frame and then does not change, so a killed run leaves a
readable file. Every dataset of ``/frames`` and ``/checkpoint`` has its planned length from the
start, its chunks are allocated, and nothing is buffered.

Each rank writes its own rows straight to their bytes, and rank 0 the numbers of a frame:
uncompressed chunks stay at the offsets that HDF5 gave them at the start. This needs no parallel
h5py, and takes a tenth of the time of h5py's own writes. The write is not collective, so a rank
that fails in it keeps no other rank waiting. If the ranks see different files, rank 0, which has
the file open, transfers the rows of one rank after another.
"""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array
from msmpetsc.comm import starts
from msmpetsc.errors import InputError
from msmpetsc.fields import DIMENSIONS, FIELDS, FRAME_FIELDS, LABELS, RANKS_SHARE, unit_of
from msmpetsc.results.disk import Storage

# largest size of a chunk [byte]; bounds the memory of a reader
CHUNK_BYTES = 64 * 2**20
# netCDF-4's name of a dimension scale without coordinates
LENGTH_ALONE = "This is a netCDF dimension but not a netCDF variable."


def open_to_write(storage: Storage, mode: str) -> h5py.File:
    """Open a new file ("w") or an existing file ("r+") so that a kill leaves it readable.

    With libver "earliest" the superblock has no flag "open for writing", which would lock the file
    of a killed run. Without a chunk cache, no data wait to be written. Without a lock, other
    programs can read a running result.
    """
    return h5py.File(storage, mode, libver="earliest", rdcc_nbytes=0, locking=False)


def is_distributed(name: str) -> bool:
    """Return whether a field of frames is distributed over the ranks."""
    return bool(RANKS_SHARE.intersection(FRAME_FIELDS[name].shape))


class Plan(NamedTuple):
    """A planned dataset: its name, shape, chunk shape and type."""

    name: str
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: str


@dataclass(frozen=True)
class Layout:
    """The sizes of all datasets that are written frame by frame.

    frames   : number of planned frames, frame 0 included
    nodes    : number of nodes of all ranks
    optional : number of rows of all ranks in the optional fields, by name: {"surface": 1000}
    rows     : shape of a node's values in each of the checkpoint's datasets, by name
    numbers  : names of the checkpoint's numbers
    """

    frames: int
    nodes: int
    optional: dict[str, int]
    rows: dict[str, tuple[int, ...]]
    numbers: tuple[str, ...]

    def plans(self) -> Iterator[Plan]:
        """Yield the datasets in the order in which they are created."""
        counts = {"position": self.nodes, **self.optional}
        for name, about in sorted(FRAME_FIELDS.items(), key=lambda item: is_distributed(item[0])):
            if name not in counts and any(isinstance(size, str) for size in about.shape[1:]):
                continue
            sizes = (size if isinstance(size, int) else counts[name] for size in about.shape[1:])
            whole = (self.frames, *sizes)
            if is_distributed(name):
                yield _rows_plan(f"frames/{name}", whole[0], whole[1], whole[2:], about.dtype)
            else:
                yield Plan(f"frames/{name}", whole, whole, about.dtype)
        yield Plan("checkpoint/step", (2,), (2,), FIELDS["checkpoint/step"].dtype)
        if self.numbers:
            name, count = "checkpoint/numbers", len(self.numbers)
            yield Plan(name, (2, count), (1, count), FIELDS[name].dtype)
        for name, shape in self.rows.items():
            yield _rows_plan(f"checkpoint/{name}", 2, self.nodes, shape, "f8")

    @property
    def nbytes(self) -> int:
        """Size of all datasets [byte]."""
        return sum(math.prod(plan.shape) * np.dtype(plan.dtype).itemsize for plan in self.plans())

    def create(self, file: h5py.File) -> None:
        """Create all datasets in a new file, without a finished frame or checkpoint."""
        for name in ("frames", "checkpoint"):
            file.create_group(name)
        for plan in self.plans():
            _plan_dataset(file, plan)
            if plan.name.startswith("frames/"):
                _name_axes(file["frames"], plan.name.removeprefix("frames/"))
        file["frames/time"][...] = np.nan
        file["checkpoint/step"][...] = -1
        if self.numbers:
            file["checkpoint/numbers"].attrs["names"] = " ".join(self.numbers)

    def first_misfit(self, file: h5py.File) -> str | None:
        """Return the first dataset that a file lacks or has in another form; None if all fit."""
        for plan in self.plans():
            dataset = file.get(plan.name)
            wanted = plan.shape, np.dtype(plan.dtype), plan.chunks
            if dataset is None or (dataset.shape, dataset.dtype, dataset.chunks) != wanted:
                return plan.name
            # a copy of the file may be compressed or lack the space of chunks
            dcpl = dataset.id.get_create_plist()
            if dcpl.get_nfilters() or dcpl.get_alloc_time() != h5py.h5d.ALLOC_TIME_EARLY:
                return plan.name
        names = file["checkpoint/numbers"].attrs["names"] if self.numbers else ""
        return None if names == " ".join(self.numbers) else "checkpoint/numbers"


def _rows_plan(name: str, times: int, rows: int, shape: tuple[int, ...], dtype: str) -> Plan:
    """Return the plan of a dataset (times, rows, *shape), each chunk with rows of a single time."""
    most = CHUNK_BYTES // (math.prod(shape) * np.dtype(dtype).itemsize)
    return Plan(name, (times, rows, *shape), (1, min(max(1, rows), most), *shape), dtype)


def _plan_dataset(file: h5py.File, plan: Plan) -> None:
    """Create a dataset with all its space allocated and nothing written."""
    dcpl = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    dcpl.set_chunk(plan.chunks)
    dcpl.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    dcpl.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    # without times the same run writes the same bytes
    dcpl.set_obj_track_times(False)
    space = h5py.h5s.create_simple(plan.shape, plan.shape)
    kind = h5py.h5t.py_create(np.dtype(plan.dtype))
    h5py.h5d.create(file.id, plan.name.encode(), kind, space, dcpl)
    file[plan.name].attrs["units"] = unit_of(plan.name)


def _name_axes(frames: h5py.Group, name: str) -> None:
    """Attach HDF5 dimension scales to a field of frames; they name its axes for netCDF readers."""
    for axis, (symbol, size) in enumerate(
        zip(FRAME_FIELDS[name].shape, frames[name].shape, strict=True)
    ):
        dimension = DIMENSIONS[symbol]
        if dimension == name:
            frames[name].make_scale(name)
            continue
        if dimension in LABELS and dimension not in frames:
            frames.create_dataset(dimension, data=LABELS[dimension], dtype=h5py.string_dtype())
            frames[dimension].make_scale(dimension)
        elif dimension not in frames:
            # never written, so that it takes no space
            frames.create_dataset(dimension, (size,), ">f4").make_scale(f"{LENGTH_ALONE}{size:10}")
        frames[name].dims[axis].attach_scale(frames[dimension])


def gather_rows(
    comm: MPI.Comm, rows: Array, counts: Sequence[int], store: Callable[[slice, Array], None]
) -> None:
    """Call store(part, piece) on rank 0 for the rows of each rank, in order (collective).

    rows   : (counts[rank], ...) this rank's rows, contiguous
    counts : number of rows of each rank

    Raises the first OSError of ``store`` on rank 0.
    """
    if comm.rank > 0:
        comm.Send(rows, dest=0)
        return
    failure = None
    for rank, part in enumerate(_parts(counts)):
        piece = rows
        if rank > 0:
            piece = np.empty((counts[rank], *rows.shape[1:]), rows.dtype)
            comm.Recv(piece, source=rank)
        try:
            if failure is None:
                store(part, piece)
        except OSError as error:
            # the other ranks still send, so keep receiving
            failure = error
    if failure is not None:
        raise failure


def scatter_rows(
    comm: MPI.Comm, rows: Array, counts: Sequence[int], load: Callable[[slice], Any]
) -> Exception | None:
    """Fill each rank's rows with load(part) of rank 0; return rank 0's reading error (collective).

    rows   : (counts[rank], ...) this rank's rows, to be filled
    counts : number of rows of each rank
    """
    if comm.rank > 0:
        comm.Recv(rows, source=0)
        return None
    failure: Exception | None = None
    for rank, part in enumerate(_parts(counts)):
        piece = rows if rank == 0 else np.zeros((counts[rank], *rows.shape[1:]), rows.dtype)
        try:
            piece[...] = load(part)
        except InputError as error:
            # the other ranks still wait, so keep sending
            failure = error
        if rank > 0:
            comm.Send(piece, dest=rank)
    return failure


def _parts(counts: Sequence[int]) -> Iterator[slice]:
    """Yield the slice of each rank in the rows of all ranks."""
    for start, count in zip(starts(np.array(counts)).tolist(), counts, strict=True):
        yield slice(start, start + count)


def open_on_all_ranks(comm: MPI.Comm, path: Path) -> int | None:
    """Return a descriptor of the file, or None if the ranks see different files (collective)."""
    descriptor = identity = None
    try:
        descriptor = os.open(path, os.O_WRONLY)
        status = os.fstat(descriptor)
        identity = status.st_ino, status.st_size
    except OSError:
        pass
    if len(set(comm.allgather(identity))) == 1 and identity:
        return descriptor
    if descriptor is not None:
        os.close(descriptor)
    return None


def chunk_offsets(dataset: h5py.Dataset, index: int) -> list[int]:
    """Return the byte offsets in the file of the chunks of dataset[index], in row order."""
    starts = range(0, dataset.shape[1], dataset.chunks[1])
    rest = (0,) * (dataset.ndim - 2)
    return [
        dataset.id.get_chunk_info_by_coord((index, start, *rest)).byte_offset for start in starts
    ]


def number_places(frames: h5py.Group) -> dict[str, tuple[np.dtype[Any], int]]:
    """Return the type and the first byte of each field of frames that is not distributed.

    Time is the last, because a frame is finished as soon as it has a time.
    """
    names = [name for name in FRAME_FIELDS if name in frames and not is_distributed(name)]
    return {
        name: (frames[name].dtype, frames[name].id.get_chunk_info(0).byte_offset)
        for name in sorted(names, key=lambda name: name == "time")
    }


def write_bytes(file: int, rows: Array, start: int, chunk: int, offsets: Sequence[int]) -> None:
    """Write contiguous rows (n, ...) at their byte offsets in a file. Raises OSError.

    file    : descriptor of the file
    start   : number of the first row in its dataset
    chunk   : rows in a chunk
    offsets : offsets of the chunks [byte]
    """
    row_bytes = rows.dtype.itemsize * math.prod(rows.shape[1:])
    done = 0
    while done < len(rows):
        number, within = divmod(start + done, chunk)
        count = min(chunk - within, len(rows) - done)
        data = rows[done : done + count].data.cast("B")
        offset = offsets[number] + within * row_bytes
        while data:
            written = os.pwrite(file, data, offset)
            data = data[written:]
            offset += written
        done += count
