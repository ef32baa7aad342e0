"""Rows on their way, in pieces, between the ranks, each of which has its own, and a file that rank 0 has open."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array

PIECE_BYTES = 64 * 2**20  # the most that rank 0 holds of another rank's rows


def pieces(count: int, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Iterator[slice]:
    """Return parts of `count` rows of this type and shape, of at most PIECE_BYTES each."""
    most = max(1, PIECE_BYTES // max(1, dtype.itemsize * math.prod(shape)))
    return (slice(start, min(start + most, count)) for start in range(0, count, most))


def gather_rows(comm: MPI.Comm, rows: Array, counts: Sequence[int], store: Callable[[int, Array], None]) -> None:
    """Hand store(start, piece), on rank 0, the rows of all ranks, one after the other (collective).

    rows   : (counts[rank], ...) this rank's, contiguous
    counts : rows of each rank
    """
    if comm.rank > 0:
        for part in pieces(len(rows), rows.dtype, rows.shape[1:]):
            comm.Send(rows[part], dest=0)
        return
    start, failure = 0, None
    for rank, count in enumerate(counts):
        for part in pieces(count, rows.dtype, rows.shape[1:]):
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


def scatter_rows(comm: MPI.Comm, rows: Array, counts: Sequence[int], load: Callable[[slice], Any]) -> Exception | None:
    """Fill each rank's rows with what load(part) gives on rank 0; return there what could not be read (collective).

    rows   : (counts[rank], ...) this rank's, to be filled
    counts : rows of each rank
    """
    if comm.rank > 0:
        for part in pieces(len(rows), rows.dtype, rows.shape[1:]):
            comm.Recv(rows[part], source=0)
        return None
    start, failure = 0, None
    for rank, count in enumerate(counts):
        for part in pieces(count, rows.dtype, rows.shape[1:]):
            piece = np.zeros((part.stop - part.start, *rows.shape[1:]), rows.dtype)
            try:
                piece[...] = load(slice(start + part.start, start + part.stop))
            except (OSError, ValueError) as error:
                failure = error  # the others still wait
            if rank > 0:
                comm.Send(piece, dest=rank)
            else:
                rows[part] = piece
        start += count
    return failure
