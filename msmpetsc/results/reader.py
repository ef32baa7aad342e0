"""Reading of result files without MPI and without PETSc: ``msmpetsc.open``.

What a file claims is checked when it is opened, before anything of that size is read: whoever made the file, it ends in
an InputError of one line, or its arrays have the shapes and types of `msmpetsc.fields`.
"""

import math
import os
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from msmpetsc.backend.arrays import Array, Indices, Positions
from msmpetsc.errors import InputError, missing_package, one_line, printable
from msmpetsc.fields import FIELDS
from msmpetsc.results.disk import refuse_no_file
from msmpetsc.scene.toml import toml_of

if TYPE_CHECKING:  # who reads frames needs neither
    from scipy.sparse import csr_array

FORMAT, FORMAT_VERSION = "msmpetsc", 1
NEEDED = ("lattice/nodes", "frames/time", "frames/position")
NAMED = {  # by datasets of numbers, what these are numbers of
    "lattice/cells": "lattice/nodes",
    "lattice/springs": "lattice/nodes",
    "lattice/pinned": "lattice/nodes",
    "surface/triangles": "surface/points",
    "obstacle/triangles": "obstacle/points",
}
PATIENCE = 10  # [s] to read a file's tables
CRASHES = (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGFPE)
DEFLATE_MOST = 1032  # zlib packs no better than this


class LazyArray:
    """A dataset that is read by indexing, as h5py's are: ``array[-1]``, ``array[:, 17]``, ``np.diff(array)``.

    Frames end with the finished ones. One index may be a list that goes up, or a mask.

    name    : of the dataset in the file, "frames/position"
    planned : shape of the dataset in the file, frames to come included
    """

    def __init__(self, dataset: h5py.Dataset, count: int | None = None):
        """Wrap a dataset; count: its rows that can be read, all if None."""
        self._dataset = dataset
        self._file, self.name = dataset.file.filename, dataset.name.lstrip("/")
        self.planned: tuple[int, ...] = dataset.shape
        self.shape: tuple[int, ...] = (len(dataset) if count is None else count, *dataset.shape[1:])
        self.dtype = dataset.dtype
        # version 0.2 and earlier wrote "unit"
        unit = dataset.attrs.get("units", dataset.attrs.get("unit", "1"))
        self.unit = unit if isinstance(unit, str) else "1"

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[Array]:
        return (self[row] for row in range(len(self)))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        return np.asarray(self[:], dtype)

    def __repr__(self) -> str:
        return f"<{self.name} {self.shape} {self.dtype} [{self.unit}]>"

    def __getitem__(self, key: Any) -> Array:
        if not self._dataset:
            raise InputError(f"{self._file} is closed")
        keys = key if isinstance(key, tuple) else (key,)
        first, *rest = keys or (...,)
        if first is Ellipsis:
            first, rest = slice(None), [..., *rest]
        try:
            if isinstance(first, slice):
                rows: Any = slice(*first.indices(len(self)))
            else:
                rows = np.arange(len(self))[first]
            values: Array = self._dataset[(rows, *rest)]
        except (TypeError, ValueError) as error:
            raise IndexError(
                f"{self.name} cannot be indexed with {key!r}: {one_line(error)}"
            ) from error
        except (OSError, RuntimeError, MemoryError) as error:
            raise InputError(
                f"{self._file}: {self.name} cannot be read: {one_line(error)}"
            ) from error
        return values


class Arrays(dict[str, LazyArray]):
    """The arrays of one group by their names: ``frames["time"]`` or ``frames.time``."""

    def __init__(self, group: str, arrays: dict[str, LazyArray]):
        super().__init__(arrays)
        self._group = group

    def __getattr__(self, name: str) -> LazyArray:
        if name not in self:
            raise AttributeError(
                f"no {self._group}/{name} in this file, but {', '.join(self) or 'nothing'}"
            )
        return self[name]

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self]

    def __repr__(self) -> str:
        return "\n".join([self._group, *map("  {!r}".format, self.values())])


class Frames(Arrays):
    """The arrays of frames by their names; its length is the number of finished frames."""

    def __len__(self) -> int:
        return len(self["time"])


class Result:
    """A result file opened for reading, also while it is written: then up to the frames finished by now.

    attributes : who made it and how: msmpetsc_version, petsc_options, ranks, command, ...
    lattice, surface, frames : their arrays as in the file, each read where it is indexed; one that the file does not
        have, because an older version wrote it or the scene did not ask for it, is not among them
    file : the same as h5py has it, unchecked where the table of fields ends; what else is there is not read
    """

    def __init__(self, path: str | Path):
        """Open the file. Raises InputError if it is no result, or damaged."""
        self.path = Path(path)
        self.file = open_result(path)
        try:
            with plain_damage(self.path):
                self.attributes = {
                    name: as_python(value) for name, value in self.file.attrs.items()
                }
                rows = {"frames": finished(self.file)}
                datasets = checked_datasets(self.file).items()
                self._datasets = {
                    name: LazyArray(data, rows.get(name.partition("/")[0]))
                    for name, data in datasets
                }
        except BaseException:
            self.close()
            raise
        self.lattice, self.surface, self._embedding = map(
            self._group, ("lattice", "surface", "embedding")
        )
        self.frames = Frames("frames", self._group("frames"))

    def _group(self, group: str) -> Arrays:
        start = f"{group}/"
        arrays = {
            name.removeprefix(start): array
            for name, array in self._datasets.items()
            if name.startswith(start)
        }
        return Arrays(group, arrays)

    def __enter__(self) -> "Result":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; a second call does nothing. Afterwards only what was read already can be used."""
        self.file.close()

    def __repr__(self) -> str:
        if not self.file:
            return f"<closed {self.path}>"
        counts = f"{len(self.frames)} frames of {len(self.lattice.nodes)} nodes"
        return f"<{self.path}: {counts}, {self.attributes.get('command', 'no command')}>"

    def __contains__(self, name: str) -> bool:
        return name in self._datasets

    def __getitem__(self, name: str) -> LazyArray:
        """Return the array of a dataset, "lattice/nodes". Raises InputError where there is none."""
        if name not in self._datasets:
            raise InputError(f"{self.path} is damaged: it has no {name}")
        return self._datasets[name]

    def indices(self, name: str) -> Indices:
        """Return a dataset of node or point numbers. Raises InputError for one out of range."""
        rows, count = self[name][:].astype(np.int64), len(self[NAMED[name]])
        plural = NAMED[name].partition("/")[2]
        if rows.size and not 0 <= rows.min() <= rows.max() < count:
            raise InputError(
                f"{self.path} is damaged: {name} names what is not among its {count} {plural}"
            )
        return rows

    def surface_at(self, frame: int) -> Positions:
        """Return the surface points (v, 3) of a frame [m]: as stored, or W @ positions."""
        if "surface" in self.frames:
            return self.frames.surface[frame]
        points: Positions = self.embedding @ self.frames.position[frame]
        return points

    @cached_property
    def scene(self) -> dict[str, Any]:
        """The scene as run, overrides included, as TOML has it: ``scene["material"]["density"]``."""
        text = self.attributes.get("scene")
        if not isinstance(text, str):
            raise InputError(f"{self.path} does not say its scene")
        try:
            return toml_of(text)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{self.path}: its scene is not TOML: {one_line(error)}") from error

    @cached_property
    def embedding(self) -> "csr_array | None":
        """W (v, n): surface points = W @ positions; None where a scene has output.surface = false.

        Raises InputError if scipy is not installed, or the file's numbers make no matrix.
        """
        try:
            from scipy.sparse import csr_array
        except ModuleNotFoundError as error:
            raise missing_package("scipy", "render") from error
        if not self._embedding:
            return None
        parts = [self[f"embedding/{name}"][:] for name in ("weights", "indices", "indptr")]
        try:
            W = csr_array(tuple(parts), shape=(len(parts[2]) - 1, len(self.lattice.nodes)))
            W.check_format(full_check=True)
        except ValueError as error:
            raise InputError(f"{self.path}: embedding is no matrix: {one_line(error)}") from error
        if "points" in self.surface and W.shape[0] != len(self.surface.points):
            raise InputError(
                f"{self.path}: embedding has {W.shape[0]} rows for {len(self.surface.points)} points"
            )
        return W

    def body_of(self, group: str) -> Indices:
        """Return the number of the body of each node ("lattice", (n,)) or surface point ("surface", (v,))."""
        if f"{group}/body" in self:
            return self[f"{group}/body"][:].astype(np.int64)
        return np.zeros(
            len(self["lattice/nodes" if group == "lattice" else "surface/points"]), np.int64
        )


def open_result(path: str | Path) -> h5py.File:
    """Open a result file for reading. Raises InputError if it is none."""
    path = Path(path)
    refuse_no_file(path)
    if not path.exists():
        raise InputError(f"{path}: no such file")
    with plain_damage(path):
        path.open("rb").close()  # is_hdf5 does not tell why it cannot read
        if not h5py.is_hdf5(path):
            raise InputError(f"{path} is not an HDF5 file")
        # No cache: it may be written just now. What is read is what stands in the file.
        try:
            # by default as other readers: HDF5 opens a file but once in a process, with the same locking
            file = h5py.File(path, "r", rdcc_nbytes=0)
        except OSError:
            # a file system without locks, or a lock of another process
            file = h5py.File(path, "r", rdcc_nbytes=0, locking=False)
    try:
        with plain_damage(path):
            _check_is_result(path, file)
    except BaseException:
        file.close()
        raise
    return file


def refuse_deadly(path: Path) -> None:
    """Raise InputError for a file on which the HDF5 library crashes or hangs: a child process reads it first.

    For commands: a process that has threads should not be forked.
    """
    child = os.fork()
    if child == 0:
        try:
            for number in (*CRASHES, signal.SIGALRM):
                signal.signal(number, signal.SIG_DFL)
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            signal.alarm(PATIENCE)
            _read_tables(path)
        except BaseException:
            pass
        finally:
            os._exit(0)
    status = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(status):
        does = "hangs" if os.WTERMSIG(status) == signal.SIGALRM else "crashes"
        raise InputError(f"{path} is damaged: the HDF5 library {does} on it")


def _read_tables(path: Path) -> None:
    """Read the metadata of every dataset, and one row of each."""
    with Result(path) as run:
        for array in run._datasets.values():
            _ = array[:, :1] if array.ndim == 3 else array[:1]


def finished(file: h5py.File) -> int:
    """Return the number of finished frames: those whose time is finite."""
    has_time = np.isfinite(file["frames/time"][:])
    return int(np.argmin(np.append(has_time, False)))


def newest_slot(steps: Indices) -> int | None:
    """Return the slot of the newest checkpoint from the steps (2,) of both slots, or None."""
    slot = int(np.argmax(steps))
    return slot if steps[slot] >= 0 else None


def _check_is_result(path: Path, file: h5py.File) -> None:
    name, version = (as_python(file.attrs.get(key)) for key in ("format", "format_version"))
    if not (isinstance(name, str) and name == FORMAT):
        raise InputError(
            f"{path} is not a result of msmpetsc run (format_version {FORMAT_VERSION})"
        )
    if not (isinstance(version, int) and version == FORMAT_VERSION):
        version = printable(str(version), 20)
        raise InputError(
            f"{path} is a result of format_version {version}; {FORMAT_VERSION} is read here"
        )
    if not isinstance(object_at(path, file, "frames"), h5py.Group):
        raise InputError(f"{path} is not a result of msmpetsc run: it has no frames")
    checked_dataset(path, file, "frames/time")


@contextmanager
def plain_damage(path: Path) -> Iterator[None]:
    """Turn errors of HDF5 and h5py on damaged files into an InputError of one line."""
    try:
        yield
    except PermissionError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except KeyError as error:
        raise InputError(
            f"{path} is damaged: it has no {printable(str(error.args[0]), 40)}"
        ) from error
    except (
        OSError,
        RuntimeError,
        ValueError,
        TypeError,
        IndexError,
        OverflowError,
        MemoryError,
    ) as error:
        raise InputError(f"{path} is damaged or cut short: {one_line(error)}") from error


def as_python(value: Any) -> Any:
    """Return an attribute as Python's own type, if there is one."""
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return value.item() if isinstance(value, np.generic) else value


def checked_datasets(file: h5py.File) -> dict[str, h5py.Dataset]:
    """Return all known datasets of a result by name. Raises InputError for a wrong one."""
    path = Path(file.filename)
    for name in NEEDED:
        if object_at(path, file, name) is None:
            raise InputError(f"{path} is damaged: it has no {name}")
    names = [name for name in FIELDS if object_at(path, file, name) is not None]
    datasets = {name: checked_dataset(path, file, name) for name in names}
    _check_sizes(path, datasets, finished(file))
    return datasets


def _check_sizes(path: Path, datasets: dict[str, h5py.Dataset], count: int) -> None:
    """Raise InputError where a size of the table of fields is not the same everywhere, or frames are too few."""
    sizes: dict[str, int] = {}
    for name, dataset in datasets.items():
        for axis, (size, symbol) in enumerate(zip(dataset.shape, FIELDS[name].shape, strict=True)):
            if symbol == "T":
                wrong = f"{count} frames are finished" if size < count else ""
            else:
                known = sizes.setdefault(symbol, size) if isinstance(symbol, str) else symbol
                wrong = f"{known} are expected" if size != known else ""
            if wrong:
                raise InputError(
                    f"{path} is damaged: {name} is {size} long along axis {axis}, and {wrong}"
                )


def object_at(path: Path, file: h5py.File, name: str) -> h5py.HLObject | None:
    """Return the HDF5 object of a name, or None. Raises InputError for links."""
    node = file
    for part in name.split("/"):
        # the lower layer: h5py's own `in` and `get` follow a link to say whether it leads anywhere
        if not isinstance(node, h5py.Group) or not node.id.links.exists(part.encode()):
            return None
        if node.id.links.get_info(part.encode()).type != h5py.h5l.TYPE_HARD:
            raise InputError(f"{path}: {name} is a link to another place, which is not followed")
        node = node[part]
    return node


def checked_dataset(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    """Return a dataset of the expected type and axes, no larger than the file can hold."""
    dataset = object_at(path, file, name)
    if not isinstance(dataset, h5py.Dataset):
        raise InputError(f"{path} is damaged: it has no dataset {name}")
    if (
        dataset.is_virtual or dataset.external
    ):  # to be asked before its shape, which HDF5 may look up there
        raise InputError(f"{path}: {name} is kept in another file, which is not opened")
    field = FIELDS.get(name)
    kinds = "f" if field is None or field.dtype.startswith("f") else "iu"
    axes = len(field.shape) if field else dataset.ndim
    if dataset.dtype.kind not in kinds or not dataset.shape or dataset.ndim != axes:
        kind = printable(str(dataset.dtype), 40)
        raise InputError(f"{path} is damaged: {name} has type {kind} and shape {dataset.shape}")
    rows = " x ".join(map(str, dataset.shape))
    most = max(dataset.size, math.prod(dataset.chunks or ()))  # a packed chunk is read whole
    claimed = most * dataset.dtype.itemsize
    if claimed > file.id.get_filesize() * (DEFLATE_MOST if dataset.compression else 1):
        raise InputError(
            f"{path} is damaged: {name} claims {rows} numbers, more than the file holds"
        )
    return dataset
