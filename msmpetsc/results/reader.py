"""Read result files without MPI and without PETSc: ``msmpetsc.open``.

A file's claims are checked when it is opened, before any array is read. A hostile or damaged file
raises an InputError of a single line. In other files all arrays are as `msmpetsc.fields` says.
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

# frames can be read without scipy
if TYPE_CHECKING:
    from scipy.sparse import csr_array

FORMAT, FORMAT_VERSION = "msmpetsc", 1
NEEDED = ("lattice/nodes", "frames/time", "frames/position")
# datasets of indices, with the dataset whose rows they number
NUMBERED = {
    "lattice/cells": "lattice/nodes",
    "lattice/springs": "lattice/nodes",
    "lattice/pinned": "lattice/nodes",
    "surface/triangles": "surface/points",
    "obstacle/triangles": "obstacle/points",
}
# time limit for reading a file's metadata [s]; an intact file takes far less
TIME_LIMIT = 10
CRASHES = (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGFPE)
# largest compression ratio of zlib [-]
DEFLATE_MOST = 1032


class LazyArray:
    """A dataset that is read when it is indexed: ``array[-1]``, ``array[:, 17]``.

    The rows of frames end with the last finished frame. The index along an axis may be an ascending
    list or a mask.

    name    : name of the dataset in the file, "frames/position"
    planned : shape of the dataset in the file, frames to come included
    """

    def __init__(self, dataset: h5py.Dataset, count: int | None = None):
        """Wrap a dataset of which the first ``count`` rows can be read, all if None."""
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
        """Read the values at an index.

        Raises IndexError for an invalid index, InputError if the file is closed or cannot be read.
        """
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
    """The arrays of a group by their names: ``frames["time"]`` or ``frames.time``."""

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
    """The arrays of frames by their names; the length is the number of finished frames."""

    def __len__(self) -> int:
        return len(self["time"])


class Result:
    """A result file opened for reading, also while a run writes it.

    A file that is being written has the frames finished when it was opened. The lattice, the
    surface and the frames hold the arrays that the file has. A file of an older version, or of a
    scene that did not ask for an array, lacks it.

    Parameters
    ----------
    path : str or Path
        The result file.

    Attributes
    ----------
    attributes : dict
        Origin of the file: msmpetsc_version, petsc_options, ranks, command, ...
    lattice, surface : Arrays
        The arrays of the lattice and of the surface, each read when it is indexed.
    frames : Frames
        The arrays of the finished frames, each read when it is indexed.
    file : h5py.File
        The same file by h5py. Datasets that the table of fields does not list are unchecked.

    Raises
    ------
    InputError
        If the file is no result, or is damaged.
    """

    def __init__(self, path: str | Path):
        """Open the file. Raises InputError if it is no result, or is damaged."""
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
        """Return the arrays of a group of datasets."""
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
        """Close the file; a second call does nothing. Arrays that were read stay valid."""
        self.file.close()

    def __repr__(self) -> str:
        if not self.file:
            return f"<closed {self.path}>"
        counts = f"{len(self.frames)} frames of {len(self.lattice.nodes)} nodes"
        return f"<{self.path}: {counts}, {self.attributes.get('command', 'no command')}>"

    def __contains__(self, name: str) -> bool:
        return name in self._datasets

    def __getitem__(self, name: str) -> LazyArray:
        """Return the array of a dataset, "lattice/nodes". Raises InputError if it is missing."""
        if name not in self._datasets:
            raise InputError(f"{self.path} is damaged: it has no {name}")
        return self._datasets[name]

    def indices(self, name: str) -> Indices:
        """Return a dataset of node or point numbers. Raises InputError if one is out of range."""
        rows = self[name][:].astype(np.int64)
        count = len(self[NUMBERED[name]])
        plural = NUMBERED[name].partition("/")[2]
        if rows.size and not 0 <= rows.min() <= rows.max() < count:
            raise InputError(
                f"{self.path} is damaged: {name} has numbers outside its {count} {plural}"
            )
        return rows

    def surface_at(self, frame: int) -> Positions:
        """Return the surface points (v, 3) [m] of a frame: as stored, or W @ positions."""
        if "surface" in self.frames:
            return self.frames.surface[frame]
        points: Positions = self.embedding @ self.frames.position[frame]
        return points

    @cached_property
    def scene(self) -> dict[str, Any]:
        """The scene as run, overrides included, as TOML: ``scene["material"]["density"]``."""
        text = self.attributes.get("scene")
        if not isinstance(text, str):
            raise InputError(f"{self.path} does not say its scene")
        try:
            return toml_of(text)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{self.path}: its scene is not TOML: {one_line(error)}") from error

    @cached_property
    def embedding(self) -> "csr_array | None":
        """W (v, n) with surface points = W @ positions; None if output.surface is false.

        Raises InputError if scipy is not installed, or the stored numbers make no matrix.
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
                f"{self.path}: embedding has {W.shape[0]} rows for "
                f"{len(self.surface.points)} points"
            )
        return W

    def body_of(self, group: str) -> Indices:
        """Return the body (n,) of each node ("lattice"), or (v,) of each point ("surface")."""
        if f"{group}/body" in self:
            return self[f"{group}/body"][:].astype(np.int64)
        points = "lattice/nodes" if group == "lattice" else "surface/points"
        return np.zeros(len(self[points]), np.int64)


def open_result(path: str | Path) -> h5py.File:
    """Open a result file for reading. Raises InputError if it is no result."""
    path = Path(path)
    refuse_no_file(path)
    if not path.exists():
        raise InputError(f"{path}: no such file")
    with plain_damage(path):
        # h5py.is_hdf5 does not say why it cannot read a file
        path.open("rb").close()
        if not h5py.is_hdf5(path):
            raise InputError(f"{path} is not an HDF5 file")
        # no chunk cache: a run may be writing the file
        try:
            # the default locking: HDF5 opens a file twice only with the same locking
            file = h5py.File(path, "r", rdcc_nbytes=0)
        except OSError:
            # the file system has no locks, or another process holds a lock
            file = h5py.File(path, "r", rdcc_nbytes=0, locking=False)
    try:
        with plain_damage(path):
            _check_is_result(path, file)
    except BaseException:
        file.close()
        raise
    return file


def refuse_deadly(path: Path) -> None:
    """Raise InputError if the HDF5 library crashes or hangs on a file.

    A child process reads the file first. Only commands may call this: threads forbid a fork.
    """
    child = os.fork()
    if child == 0:
        try:
            for number in (*CRASHES, signal.SIGALRM):
                signal.signal(number, signal.SIG_DFL)
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            signal.alarm(TIME_LIMIT)
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
    """Read the metadata of every dataset and a row of each."""
    with Result(path) as run:
        for array in run._datasets.values():
            _ = array[:, :1] if array.ndim == 3 else array[:1]


def finished(file: h5py.File) -> int:
    """Return the number of finished frames: frames with a finite time."""
    has_time = np.isfinite(file["frames/time"][:])
    return int(np.argmin(np.append(has_time, False)))


def newest_slot(steps: Indices) -> int | None:
    """Return the slot of the newest checkpoint, given the steps (2,) of both slots, or None."""
    slot = int(np.argmax(steps))
    return slot if steps[slot] >= 0 else None


def _check_is_result(path: Path, file: h5py.File) -> None:
    """Raise InputError unless format, version and frames of a file are those of a result."""
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
    """Turn errors of HDF5 and h5py on damaged files into an InputError of a single line."""
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
    """Return an attribute's value as Python's own type, if there is one."""
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return value.item() if isinstance(value, np.generic) else value


def checked_datasets(file: h5py.File) -> dict[str, h5py.Dataset]:
    """Return all known datasets of a result by name. Raises InputError for an invalid dataset."""
    path = Path(file.filename)
    for name in NEEDED:
        if object_at(path, file, name) is None:
            raise InputError(f"{path} is damaged: it has no {name}")
    names = [name for name in FIELDS if object_at(path, file, name) is not None]
    datasets = {name: checked_dataset(path, file, name) for name in names}
    _check_sizes(path, datasets, finished(file))
    return datasets


def _check_sizes(path: Path, datasets: dict[str, h5py.Dataset], count: int) -> None:
    """Raise InputError if datasets differ in a common size, or have too few frames."""
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
        # h5py's own `in` and `get` would follow a link, so its low-level API is used
        if not isinstance(node, h5py.Group) or not node.id.links.exists(part.encode()):
            return None
        if node.id.links.get_info(part.encode()).type != h5py.h5l.TYPE_HARD:
            raise InputError(f"{path}: {name} is a link to another place, which is not followed")
        node = node[part]
    return node


def checked_dataset(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    """Return a dataset, checked for type, axes and size.

    Raises InputError if it is missing, invalid, too large for the file, or kept in another file.
    """
    dataset = object_at(path, file, name)
    if not isinstance(dataset, h5py.Dataset):
        raise InputError(f"{path} is damaged: it has no dataset {name}")
    # checked before the shape, which HDF5 may look up in the other file
    if dataset.is_virtual or dataset.external:
        raise InputError(f"{path}: {name} is kept in another file, which is not opened")
    field = FIELDS.get(name)
    kinds = "f" if field is None or field.dtype.startswith("f") else "iu"
    axes = len(field.shape) if field else dataset.ndim
    if dataset.dtype.kind not in kinds or not dataset.shape or dataset.ndim != axes:
        kind = printable(str(dataset.dtype), 40)
        raise InputError(f"{path} is damaged: {name} has type {kind} and shape {dataset.shape}")
    rows = " x ".join(map(str, dataset.shape))
    # HDF5 reads a compressed chunk as a whole
    most = max(dataset.size, math.prod(dataset.chunks or ()))
    claimed = most * dataset.dtype.itemsize
    if claimed > file.id.get_filesize() * (DEFLATE_MOST if dataset.compression else 1):
        raise InputError(
            f"{path} is damaged: {name} claims {rows} numbers, more than the file holds"
        )
    return dataset
