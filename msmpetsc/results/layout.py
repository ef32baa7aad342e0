"""The layout of a result file: all metadata before the first frame, so that a kill leaves it readable.

Every dataset of ``/frames`` and ``/checkpoint`` has its planned length from the start, its chunks
allocated, nothing buffered. While frames are written, no metadata changes.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import h5py
import numpy as np

from msmpetsc.fields import FIELDS, FRAME_FIELDS, RANKS_SHARE, unit_of
from msmpetsc.results.disk import Storage

CHUNK_BYTES = 64 * 2**20


def open_to_write(storage: Storage, mode: str) -> h5py.File:
    """Open a new file ("w") or an existing one ("r+") in a way that a kill cannot spoil.

    libver earliest: its superblock has no flag "open for writing", which would shut a killed run's
    file. No chunk cache: nothing waits to be written. No lock: a running result may be looked at.
    """
    return h5py.File(storage, mode, libver="earliest", rdcc_nbytes=0, locking=False)


def of_ranks(name: str) -> bool:
    """Return whether a field of frames is distributed over the ranks."""
    return bool(RANKS_SHARE.intersection(FRAME_FIELDS[name].shape))


class Plan(NamedTuple):
    """One planned dataset: name, shape, shape of its chunks, and type."""

    name: str
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: str


@dataclass(frozen=True)
class Layout:
    """The sizes of all datasets that are written frame by frame.

    frames  : planned, frame 0 included
    nodes   : of all ranks
    also    : rows, of all ranks, of fields that not all scenes ask for, by their names: {"surface": 1000}
    rows    : by name, shape of a node's part of the checkpoint's rows
    numbers : names of the checkpoint's numbers
    """

    frames: int = 0
    nodes: int = 0
    also: dict[str, int] = field(default_factory=dict)
    rows: dict[str, tuple[int, ...]] = field(default_factory=dict)
    numbers: tuple[str, ...] = ()

    def plans(self) -> Iterator[Plan]:
        """Yield the datasets in the order in which they are laid out."""
        counts = {"position": self.nodes, **self.also}
        for last in (False, True):
            for name, about in FRAME_FIELDS.items():
                is_left_out = name not in counts and any(isinstance(size, str) for size in about.shape[1:])
                if is_left_out or of_ranks(name) != last:
                    continue
                shape = tuple(size if isinstance(size, int) else counts[name] for size in about.shape[1:])
                if last:
                    yield _rows_plan(f"frames/{name}", self.frames, shape[0], shape[1:], about.dtype)
                else:
                    yield Plan(f"frames/{name}", (self.frames, *shape), (self.frames, *shape), about.dtype)
        # The checkpoint comes last: it is never trimmed, so the end of the file never moves back. (HDF5 would cut the
        # file before noting its new length; killed in between, it could not be opened.)
        yield Plan("checkpoint/step", (2,), (2,), FIELDS["checkpoint/step"].dtype)
        if self.numbers:
            count = len(self.numbers)
            yield Plan("checkpoint/numbers", (2, count), (1, count), FIELDS["checkpoint/numbers"].dtype)
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
        file["frames/time"][...] = np.nan
        file["checkpoint/step"][...] = -1
        if self.numbers:
            file["checkpoint/numbers"].attrs["names"] = " ".join(self.numbers)

    def first_misfit(self, file: h5py.File) -> str | None:
        """Return the name of the first dataset that a file lacks or has in another shape; None if all fit."""
        for plan in self.plans():
            dataset = file.get(plan.name)
            if dataset is None or dataset.shape != plan.shape or dataset.dtype != np.dtype(plan.dtype):
                return plan.name
        return None


def _rows_plan(name: str, times: int, rows: int, shape: tuple[int, ...], dtype: str) -> Plan:
    """Return the plan of a dataset (times, rows, *shape), whose chunks hold rows of one time."""
    most = CHUNK_BYTES // (math.prod(shape) * np.dtype(dtype).itemsize)
    return Plan(name, (times, rows, *shape), (1, min(max(1, rows), most), *shape), dtype)


def _plan_dataset(file: h5py.File, plan: Plan) -> None:
    """Create a dataset that can shrink, with all its space in the file allocated now and nothing written.

    Through h5py's lower layer: its create_dataset insists on filling datasets that can change their size.
    """
    dcpl = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    dcpl.set_chunk(plan.chunks)
    dcpl.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    dcpl.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    dcpl.set_obj_track_times(False)  # the same run makes the same bytes
    if plan.name == "frames/time":
        dcpl.set_fill_value(np.array(np.nan))  # what shrinking puts behind the new end
    space = h5py.h5s.create_simple(plan.shape, plan.shape)
    kind = h5py.h5t.py_create(np.dtype(plan.dtype))
    h5py.h5d.create(file.id, plan.name.encode(), kind, space, dcpl)
    file[plan.name].attrs["unit"] = unit_of(plan.name)
