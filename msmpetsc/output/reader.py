"""Result files, read without MPI and without PETSc: ``msmpetsc.open``.

What a file claims is checked when it is opened, before anything of that size is read: whoever made the file, it ends in
an InputError of one line, or its arrays have the shapes and types of format_version 1.
"""

import math
import os
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
from scipy.sparse import csr_array

from msmpetsc.errors import InputError, one_line, printable
from msmpetsc.output.lazy import Arrays, LazyArray
from msmpetsc.scene.toml import toml_of

FORMAT, FORMAT_VERSION = "msmpetsc", 1
NEEDED = ("lattice/nodes", "frames/time", "frames/position")
# Kind of numbers, and shape: a letter stands for the same number throughout, T for at least the finished frames.
SHAPES = {
    "lattice/nodes": ("f", ("n", 3)),
    "lattice/cells": ("iu", ("c", 8)),
    "lattice/cell_kind": ("iu", ("c",)),
    "lattice/springs": ("iu", ("s", 2)),
    "lattice/rest_length": ("f", ("s",)),
    "lattice/stiffness": ("f", ("s",)),
    "lattice/mass": ("f", ("n",)),
    "lattice/pinned": ("iu", ("p",)),
    "surface/points": ("f", ("v", 3)),
    "surface/triangles": ("iu", ("f", 3)),
    "embedding/indptr": ("iu", ("r",)),
    "embedding/indices": ("iu", ("e",)),
    "embedding/weights": ("f", ("e",)),
    "checkpoint/step": ("i", (2,)),
    "checkpoint/q": ("f", (2, "n", 3)),
    "checkpoint/q_previous": ("f", (2, "n", 3)),
    "frames/time": ("f", ("T",)),
    "frames/position": ("f", ("T", "n", 3)),
    "frames/surface": ("f", ("T", "v", 3)),
    "frames/momentum": ("f", ("T", 3)),
}
PATIENCE = 10  # [s] for a look at a file's tables
CRASHES = (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGFPE)
DEFLATE_MOST = 1032  # zlib packs no better than this


class Checkpoint(NamedTuple):
    """Enough to go on: q_n and q_(n-1), (n, 3) [m], after so many steps."""

    step: int
    q: np.ndarray
    q_previous: np.ndarray


class Result:
    """A result file, opened to be read; also one that is being written, up to the frames finished by now.

    attributes : who made it and how: msmpetsc_version, petsc_options, ranks, command, ...
    lattice, surface, frames : their arrays as in the file, each read where it is indexed; one that the file does not
        have, because an older version wrote it or the scene did not ask for it, is not among them
    """

    def __init__(self, path: str | Path):
        """Raises InputError, one line, if the file is no result, or damaged."""
        self.path = Path(path)
        self._file = open_result(path)
        try:
            with damage_told(self.path):
                self.attributes = {name: _plain(value) for name, value in self._file.attrs.items()}
                datasets = checked_datasets(self._file)
                groups = ("lattice", "surface", "frames", "embedding", "checkpoint")
                self.lattice, self.surface, self.frames, self._embedding, self._checkpoint = (
                    self._arrays(group, datasets) for group in groups
                )
        except BaseException:
            self.close()
            raise

    def _arrays(self, group: str, datasets: dict[str, h5py.Dataset]) -> Arrays:
        count = finished(self._file) if group == "frames" else None
        names = [name for name in datasets if name.startswith(f"{group}/")]
        return Arrays(group, {name.partition("/")[2]: LazyArray(datasets[name], count) for name in names})

    def __enter__(self) -> "Result":
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def close(self) -> None:
        """Nothing can be read afterwards but what was; a second call does nothing."""
        self._file.close()

    def __repr__(self) -> str:
        if not self._file:
            return f"<closed {self.path}>"
        lattice, frames = self.lattice.nodes.shape[0], len(self.frames.time)
        return f"<{self.path}: {frames} frames of {lattice} nodes, {self.attributes.get('command', 'no command')}>"

    @cached_property
    def scene(self) -> dict:
        """The scene as run, overrides included, as TOML has it: ``scene["material"]["density"]``."""
        text = self.attributes.get("scene")
        if not isinstance(text, str):
            raise InputError(f"{self.path} does not say its scene")
        try:
            return toml_of(text)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{self.path}: its scene is not TOML: {one_line(error)}") from error

    @cached_property
    def embedding(self) -> csr_array | None:
        """W (v, n): surface points = W @ positions; None where the scene has output.surface = false."""
        if not self._embedding:
            return None
        if len(self._embedding) < 3:
            raise InputError(f"{self.path}: a part of embedding is missing")
        parts = [self._embedding[name][:] for name in ("weights", "indices", "indptr")]
        try:
            W = csr_array(tuple(parts), shape=(len(parts[2]) - 1, len(self.lattice.nodes)))
            W.check_format(full_check=True)
        except ValueError as error:
            raise InputError(f"{self.path}: embedding is no matrix: {one_line(error)}") from error
        if "points" in self.surface and W.shape[0] != len(self.surface.points):
            raise InputError(f"{self.path}: embedding has {W.shape[0]} rows for {len(self.surface.points)} points")
        return W

    @property
    def checkpoint(self) -> Checkpoint | None:
        """The newest there is now, or None."""
        if len(self._checkpoint) < 3:
            return None
        while True:
            step = self._checkpoint.step[:]
            slot = int(np.argmax(step))
            if step[slot] < 0:
                return None
            found = Checkpoint(int(step[slot]), self._checkpoint.q[slot], self._checkpoint.q_previous[slot])
            if self._checkpoint.step[slot] == found.step:  # or a running process has just begun to replace it
                return found

    def to_xarray(self):
        """The frames as an xarray.Dataset, read where it is used: with coordinates, units and long names."""
        from msmpetsc.output.labelled import labelled

        return labelled(self)


def open_result(path: str | Path) -> h5py.File:
    """Open a result file to read it; InputError if it is none."""
    path = Path(path)
    if not path.is_file():
        kind = "a folder" if path.is_dir() else "a pipe or a device"
        raise InputError(f"{path} is {kind}, not a file" if path.exists() else f"{path}: no such file")
    with damage_told(path):
        path.open("rb").close()  # is_hdf5 does not tell why it cannot read
        if not h5py.is_hdf5(path):
            raise InputError(f"{path} is not an HDF5 file")
        # No lock, no cache: it may be written just now. What is read is what stands in the file.
        file = h5py.File(path, "r", locking=False, rdcc_nbytes=0)
    try:
        with damage_told(path):
            _check_is_result(path, file)
    except BaseException:
        file.close()
        raise
    return file


def refuse_deadly(path: Path) -> None:
    """Raise InputError for a file on which the HDF5 library itself crashes or hangs: a child process looks first.

    For commands: a process that has threads should not be forked.
    """
    child = os.fork()
    if child == 0:
        try:
            for number in (*CRASHES, signal.SIGALRM):
                signal.signal(number, signal.SIG_DFL)
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            signal.alarm(PATIENCE)
            _look_at_all(path)
        except BaseException:
            pass
        finally:
            os._exit(0)
    status = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(status):
        does = "hangs" if os.WTERMSIG(status) == signal.SIGALRM else "crashes"
        raise InputError(f"{path} is damaged: the HDF5 library {does} on it")


def _look_at_all(path: Path) -> None:
    """Every table of the file and of each dataset a row; of the frames one row of each."""
    with Result(path) as run:
        for arrays in (run.lattice, run.surface, run.frames, run._embedding, run._checkpoint):
            for array in arrays.values():
                array[:, :1] if array.ndim == 3 else array[:1]


def finished(file: h5py.File) -> int:
    """The number of finished frames: those whose time is finite."""
    there = np.isfinite(file["frames/time"][:])
    return int(np.argmin(np.append(there, False)))


def read_checkpoint(file: h5py.File, rows: slice = slice(None)) -> tuple[int, np.ndarray, np.ndarray] | None:
    """The newest checkpoint, or None: step index, q_n and q_(n-1) of these rows of nodes (n,3) [m].

    Raises InputError, one line, for a checkpoint that no run wrote so.
    """
    path = Path(file.filename)
    with damage_told(path):
        if _held(path, file, "checkpoint") is None:
            return None
        steps, q, q_previous = (
            checked_dataset(path, file, f"checkpoint/{name}") for name in ("step", "q", "q_previous")
        )
        if steps.shape != (2,) or not q.shape == q_previous.shape == (2, q.shape[1], 3):
            raise InputError(
                f"{path} is damaged: its checkpoint has shapes {steps.shape}, {q.shape}, {q_previous.shape}"
            )
        slot = int(np.argmax(steps))
        step = int(steps[slot])
        return None if step < 0 else (step, q[slot, rows], q_previous[slot, rows])


def checked_checkpoint(file: h5py.File) -> list[str] | None:
    """The names of its numbers, [] if it has none; None if the file has no checkpoint.

    Raises InputError for one that no run wrote so.
    """
    path = Path(file.filename)
    with damage_told(path):
        group = _held(path, file, "checkpoint")
        if group is None:
            return None
        if not isinstance(group, h5py.Group):
            raise InputError(f"{path} is damaged: its checkpoint is no group")
        nodes, names = len(file["lattice/nodes"]), []
        for name in group:
            if not name.isprintable():  # lines that tell of it would not be lines
                raise InputError(f"{path} is damaged: its checkpoint has {printable(name, 40)!r}")
            dataset = checked_dataset(path, file, f"checkpoint/{name}")
            if name == "numbers":
                names, shape = str(_plain(dataset.attrs.get("names", ""))).split(), (2, dataset.shape[-1])
            else:
                shape = (2,) if name == "step" else (2, nodes, *dataset.shape[2:])
            kind = "i8" if name == "step" else "f8"
            if dataset.shape != shape or dataset.dtype != kind or (name == "numbers" and len(names) != shape[1]):
                raise InputError(f"{path} is damaged: checkpoint/{name} has shape {dataset.shape}")
        if not {"step", "q", "q_previous"} <= set(group):
            raise InputError(f"{path} is damaged: its checkpoint is not whole")
        return names


def _check_is_result(path: Path, file: h5py.File) -> None:
    name, version = (_plain(file.attrs.get(key)) for key in ("format", "format_version"))
    if not (isinstance(name, str) and name == FORMAT):
        raise InputError(f"{path} is not a result of msmpetsc run (format_version {FORMAT_VERSION})")
    if not (isinstance(version, int) and version == FORMAT_VERSION):
        version = printable(str(version), 20)
        raise InputError(f"{path} is a result of format_version {version}; {FORMAT_VERSION} is read here")
    if not isinstance(_held(path, file, "frames"), h5py.Group):
        raise InputError(f"{path} is not a result of msmpetsc run: it has no frames")
    checked_dataset(path, file, "frames/time")


@contextmanager
def damage_told(path: Path) -> Iterator[None]:
    """One line for what HDF5 and h5py raise on files that no one wrote so."""
    try:
        yield
    except PermissionError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except KeyError as error:
        raise InputError(f"{path} is damaged: it has no {printable(str(error.args[0]), 40)}") from error
    except (OSError, RuntimeError, ValueError, TypeError, OverflowError, MemoryError) as error:
        raise InputError(f"{path} is damaged or cut short: {one_line(error)}") from error


def _plain(value):
    """An attribute as Python's own type, where there is one."""
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return value.item() if isinstance(value, np.generic) else value


def checked_datasets(file: h5py.File) -> dict[str, h5py.Dataset]:
    """All that belong to a result, "frames/time" and the like; InputError if one is not what it should be."""
    path = Path(file.filename)
    for name in NEEDED:
        if _held(path, file, name) is None:
            raise InputError(f"{path} is damaged: it has no {name}")
    names = [name for name in SHAPES if _held(path, file, name) is not None]
    names += [f"frames/{name}" for name in file["frames"] if f"frames/{name}" not in SHAPES and _numbers(file, name)]
    datasets = {name: checked_dataset(path, file, name) for name in names}
    count, sizes = finished(file), {}
    for name, dataset in datasets.items():
        for axis, (size, symbol) in enumerate(zip(dataset.shape, _expected(name, dataset)[1], strict=True)):
            if symbol == "T":
                wrong = f"{count} frames are finished" if size < count else ""
            else:
                known = sizes.setdefault(symbol, size) if isinstance(symbol, str) else symbol
                wrong = f"{known} are expected" if size != known else ""
            if wrong:
                raise InputError(f"{path} is damaged: {name} is {size} long along axis {axis}, and {wrong}")
    return datasets


def _numbers(file: h5py.File, name: str) -> bool:
    """Whether that is a series of numbers; a newer version may keep other things among the frames."""
    frames = file["frames"]
    if not name.isprintable() or frames.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
        return False
    found = frames[name]
    return isinstance(found, h5py.Dataset) and not _elsewhere(found) and found.dtype.kind in "iuf"


def _expected(name: str, dataset: h5py.Dataset) -> tuple[str, tuple]:
    """Kinds and shape; of what is not known here, any numbers will do that are as many as the frames."""
    return SHAPES.get(name) or ("iuf", ("T", *dataset.shape[1:]))


def _held(path: Path, file: h5py.File, name: str) -> h5py.HLObject | None:
    """What stands in the file under a name, None if nothing does; InputError if a link on the way leads elsewhere."""
    here = file
    for part in name.split("/"):
        # the lower layer: h5py's own `in` and `get` follow a link to say whether it leads anywhere
        if not isinstance(here, h5py.Group) or not here.id.links.exists(part.encode()):
            return None
        if here.id.links.get_info(part.encode()).type != h5py.h5l.TYPE_HARD:
            raise InputError(f"{path}: {name} is a link to another place, which is not followed")
        here = here[part]
    return here


def _elsewhere(dataset: h5py.Dataset) -> bool:
    """Whether its numbers are in other files. To be asked before its shape, which HDF5 may look for there."""
    return dataset.is_virtual or bool(dataset.external)


def checked_dataset(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    """The dataset, if it holds numbers as it should, of as many axes, and no more than the file can hold."""
    dataset = _held(path, file, name)
    if not isinstance(dataset, h5py.Dataset):
        raise InputError(f"{path} is damaged: it has no dataset {name}")
    if _elsewhere(dataset):
        raise InputError(f"{path}: {name} is kept in another file, which is not opened")
    kinds, shape = _expected(name, dataset) if dataset.shape else ("", ())
    if dataset.dtype.kind not in kinds or len(dataset.shape) != len(shape):
        kind = printable(str(dataset.dtype), 40)
        raise InputError(f"{path} is damaged: {name} has type {kind} and shape {dataset.shape}")
    rows = " x ".join(map(str, dataset.shape))
    most = max(dataset.size, math.prod(dataset.chunks or ()))  # a packed chunk is read whole
    claimed = most * dataset.dtype.itemsize
    if claimed > file.id.get_filesize() * (DEFLATE_MOST if dataset.compression else 1):
        raise InputError(f"{path} is damaged: {name} claims {rows} numbers, more than the file holds")
    return dataset
