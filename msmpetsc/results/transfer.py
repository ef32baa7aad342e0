"""Transfer of distributed rows between the ranks and a file that rank 0 has open.

Rank 0 takes or gives them in pieces. Or each rank writes its own straight to their bytes: a frame's are known from the
start, for its chunks lie where HDF5 put them when the file was laid out, uncompressed, and stay there (results.layout).
That needs nothing of h5py, and as nothing is collective no rank waits for another that has failed.
"""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array
from msmpetsc.errors import InputError

PIECE_BYTES = 64 * 2**20  # the most that rank 0 holds of another rank's rows


def pieces(rows: Array, counts: Sequence[int]) -> Iterator[tuple[int, slice, slice]]:
    """Yield pieces of the ranks' rows of at most PIECE_BYTES: rank, its own slice, and the slice of all rows.

    rows   : (counts[rank], ...) this rank's
    counts : rows of each rank
    """
    most = max(1, PIECE_BYTES // max(1, rows.dtype.itemsize * math.prod(rows.shape[1:])))
    start = 0
    for rank, count in enumerate(counts):
        for begin in range(0, count, most):
            end = min(begin + most, count)
            yield rank, slice(begin, end), slice(start + begin, start + end)
        start += count


def gather_rows(comm: MPI.Comm, rows: Array, counts: Sequence[int], store: Callable[[slice, Array], None]) -> None:
    """Call store(part, piece) on rank 0 for the rows of all ranks, in order (collective).

    rows   : (counts[rank], ...) this rank's, contiguous
    counts : rows of each rank
    """
    failure = None
    for rank, own, part in pieces(rows, counts):
        if comm.rank == rank > 0:
            comm.Send(rows[own], dest=0)
        if comm.rank > 0:
            continue
        piece = rows[own]
        if rank > 0:
            piece = np.empty((own.stop - own.start, *rows.shape[1:]), rows.dtype)
            comm.Recv(piece, source=rank)
        try:
            if failure is None:
                store(part, piece)
        except OSError as error:
            failure = error  # the others still send: hear them out
    if failure is not None:
        raise failure


def scatter_rows(comm: MPI.Comm, rows: Array, counts: Sequence[int], load: Callable[[slice], Any]) -> Exception | None:
    """Fill each rank's rows with load(part) of rank 0, and return an error of reading there (collective).

    rows   : (counts[rank], ...) this rank's, to be filled
    counts : rows of each rank
    """
    failure: Exception | None = None
    for rank, own, part in pieces(rows, counts):
        if comm.rank == rank > 0:
            comm.Recv(rows[own], source=0)
        if comm.rank > 0:
            continue
        piece = np.zeros((own.stop - own.start, *rows.shape[1:]), rows.dtype)
        try:
            piece[...] = load(part)
        except InputError as error:
            failure = error  # the others still wait
        if rank > 0:
            comm.Send(piece, dest=rank)
        else:
            rows[own] = piece
    return failure


def open_on_all_ranks(comm: MPI.Comm, path: Path) -> int | None:
    """Return a descriptor of the file on each rank; None where the ranks see different files (collective)."""
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
    """Return the byte offsets in the file of the chunks of dataset[index], in the order of its rows."""
    starts = range(0, dataset.shape[1], dataset.chunks[1])
    rest = (0,) * (dataset.ndim - 2)
    return [dataset.id.get_chunk_info_by_coord((index, start, *rest)).byte_offset for start in starts]


def write_bytes(file: int, rows: Array, start: int, chunk: int, offsets: Sequence[int]) -> None:
    """Write contiguous rows (n, ...) at their byte offsets in a file. Raises OSError.

    start   : number of the first of them in its dataset
    chunk   : rows of a chunk
    offsets : where the chunks begin [byte]
    """
    row_bytes = rows.dtype.itemsize * math.prod(rows.shape[1:])
    done = 0
    while done < len(rows):
        number, within = divmod(start + done, chunk)
        count = min(chunk - within, len(rows) - done)
        _write_all(file, rows[done : done + count].data.cast("B"), offsets[number] + within * row_bytes)
        done += count


def _write_all(file: int, data: memoryview, offset: int) -> None:
    while data:
        written = os.pwrite(file, data, offset)
        data, offset = data[written:], offset + written
