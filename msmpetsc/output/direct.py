"""Rows written by the ranks that have them, straight to their places in an HDF5 file that one rank has open.

A frame's place is known from the start: its chunks lie where HDF5 put them when the file was laid out, uncompressed,
and stay there (output.writer). So bytes suffice, whichever h5py there is, and as nothing is collective no rank waits
for another that has failed.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np


def reach(comm, path: Path) -> int | None:
    """A descriptor of the file on each rank, or None on all if not all of them see the same file (collective)."""
    here, size = None, None
    try:
        here = os.open(path, os.O_WRONLY)
        status = os.fstat(here)
        size = status.st_ino, status.st_size
    except OSError:
        pass
    if len(set(comm.allgather(size))) == 1 and size:
        return here
    if here is not None:
        os.close(here)
    return None


def chunk_places(dataset: h5py.Dataset, index: int) -> list[int]:
    """Where in the file [byte] the chunks of dataset[index] begin, in the order of its rows."""
    starts = range(0, dataset.shape[1], dataset.chunks[1])
    rest = (0,) * (dataset.ndim - 2)
    return [dataset.id.get_chunk_info_by_coord((index, start, *rest)).byte_offset for start in starts]


def write_rows(file: int, rows: np.ndarray, start: int, chunk: int, places: Sequence[int]) -> None:
    """Put rows (n, ...), contiguous, that begin at row ``start``, into chunks of ``chunk`` rows each. Raises OSError."""
    bytes_of_row = rows.dtype.itemsize * int(np.prod(rows.shape[1:], dtype=np.int64))
    done = 0
    while done < len(rows):
        number, within = divmod(start + done, chunk)
        count = min(chunk - within, len(rows) - done)
        _write_all(file, memoryview(rows[done : done + count]).cast("B"), places[number] + within * bytes_of_row)
        done += count


def _write_all(file: int, data: memoryview, place: int) -> None:
    while data:
        written = os.pwrite(file, data, place)
        data, place = data[written:], place + written
