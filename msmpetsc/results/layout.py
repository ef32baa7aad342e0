"""Lay out a result file, and transfer distributed rows between the file and the ranks.

All metadata is written before the first frame and then does not change, so a killed run leaves a
readable file. Every dataset of ``/frames`` and ``/checkpoint`` has its planned length and its place
in the file from the start.

Rank 0, which has the file open, transfers the rows of one rank after another. Alternatively each
rank writes its own rows straight to their bytes. This needs no parallel h5py. As nothing is
collective, no rank waits for a rank that has failed.
"""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array
from msmpetsc.comm import starts
from msmpetsc.errors import InputError
from msmpetsc.fields import DIMENSIONS, FIELDS, FRAME_FIELDS, LABELS, RANKS_SHARE, unit_of
from msmpetsc.results.disk import Storage

# netCDF-4's name of a dimension scale without coordinates
LENGTH_ALONE = "This is a netCDF dimension but not a netCDF variable."


def open_to_write(storage: Storage, mode: str) -> h5py.File:
    """Open a new file ("w") or an existing file ("r+") so that a kill leaves it readable.

    The superblock of libver "earliest" has no flag "open for writing", which would lock the file of
    a killed run. Without a lock other programs can read a running result.
    """
    return h5py.File(storage, mode, libver="earliest", locking=False)


def is_distributed(name: str) -> bool:
    """Return whether a field of frames is distributed over the ranks."""
    return bool(RANKS_SHARE.intersection(FRAME_FIELDS[name].shape))


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

    def plans(self) -> Iterator[tuple[str, tuple[int, ...]]]:
        """Yield name and shape of each dataset."""
        counts = {"position": self.nodes, **self.optional}
        for name, about in FRAME_FIELDS.items():
            sizes = about.shape[1:]
            if name in counts or not any(isinstance(size, str) for size in sizes):
                rows = (size if isinstance(size, int) else counts[name] for size in sizes)
                yield f"frames/{name}", (self.frames, *rows)
        yield "checkpoint/step", (2,)
        if self.numbers:
            yield "checkpoint/numbers", (2, len(self.numbers))
        for name, shape in self.rows.items():
            yield f"checkpoint/{name}", (2, self.nodes, *shape)

    @property
    def nbytes(self) -> int:
        """Size of all datasets [byte]."""
        return sum(math.prod(shape) * dtype_of(name).itemsize for name, shape in self.plans())

    def create(self, file: h5py.File) -> None:
        """Create all datasets in a new file, without a finished frame or checkpoint."""
        for name in ("frames", "checkpoint"):
            file.create_group(name)
        for name, shape in self.plans():
            dcpl = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            dcpl.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
            dcpl.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
            # without times the same run writes the same bytes
            options: dict[str, Any] = dict(dcpl=dcpl, track_times=False)
            dataset = file.create_dataset(name, shape, dtype_of(name), **options)
            dataset.attrs["units"] = unit_of(name)
            if name.startswith("frames/"):
                _name_axes(file["frames"], name.removeprefix("frames/"))
        file["frames/time"][...] = np.nan
        file["checkpoint/step"][...] = -1
        if self.numbers:
            file["checkpoint/numbers"].attrs["names"] = " ".join(self.numbers)

    def first_misfit(self, file: h5py.File) -> str | None:
        """Return the first dataset that a file lacks or has in another form; None if all fit."""
        for name, shape in self.plans():
            dataset = file.get(name)
            # version 0.2 and earlier wrote chunks, without a single place in the file
            if dataset is None or dataset.shape != shape or dataset.chunks:
                return name
            if dataset.dtype != dtype_of(name):
                return name
        names = file["checkpoint/numbers"].attrs["names"] if self.numbers else ""
        return None if names == " ".join(self.numbers) else "checkpoint/numbers"


def dtype_of(name: str) -> np.dtype[Any]:
    """Return the type of a dataset; rows of a checkpoint that an integrator names are f8."""
    return np.dtype(FIELDS[name].dtype if name in FIELDS else "f8")


def _name_axes(frames: h5py.Group, name: str) -> None:
    """Attach HDF5 dimension scales to the axes of a dataset of frames.

    Readers of netCDF take the names of the axes from them.
    """
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
    """Yield the slice of all rows that each rank has."""
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


def write_bytes(file: int, rows: Array, offset: int) -> None:
    """Write contiguous rows (n, ...) at an offset [byte] in a file, by its descriptor.

    Raises OSError.
    """
    data = rows.ravel().view(np.uint8).data
    while data:
        written = os.pwrite(file, data, offset)
        data = data[written:]
        offset += written
