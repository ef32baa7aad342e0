"""Read result files without MPI and without PETSc: ``msmpetsc.open``.

The file is checked when it is opened (results.untrusted_file): then all arrays have the types and
shapes of `msmpetsc.fields`.
"""

import tomllib
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from msmpetsc.backend.arrays import Array, Indices, Positions
from msmpetsc.errors import InputError, missing_package, one_line
from msmpetsc.results.untrusted_file import (
    as_python,
    checked_datasets,
    finished,
    open_result,
    plain_damage,
)

# frames can be read without scipy
if TYPE_CHECKING:
    from scipy.sparse import csr_array

# datasets of indices, and the dataset whose rows they number
NUMBERED = {
    "lattice/cells": "lattice/nodes",
    "lattice/springs": "lattice/nodes",
    "lattice/pinned": "lattice/nodes",
    "surface/triangles": "surface/points",
    "obstacle/triangles": "obstacle/points",
}


class LazyArray:
    """A dataset that is read when it is indexed: ``array[-1]``, ``array[:, 17]``.

    The rows of frames end with the last finished frame. The index along an axis may be an ascending
    list or a mask.

    name    : name of the dataset in the file, "frames/position"
    planned : shape of the dataset in the file, frames to come included
    """

    def __init__(self, dataset: h5py.Dataset, count: int | None = None):
        """Wrap a dataset; only its first ``count`` rows can be read, all if None."""
        self._dataset = dataset
        self._file, self.name = dataset.file.filename, dataset.name.lstrip("/")
        self.planned: tuple[int, ...] = dataset.shape
        self.shape: tuple[int, ...] = (len(dataset) if count is None else count, *dataset.shape[1:])
        self.dtype = dataset.dtype
        unit = dataset.attrs.get("units", "1")
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

    If a run is writing the file, only the frames finished at the opening can be read. ``lattice``,
    ``surface`` and ``frames`` hold the arrays that the file has. A file lacks an array if its scene
    did not ask for it, or if an older version wrote the file.

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
        The file as h5py opens it. Only the datasets of `msmpetsc.fields` are checked.

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
                attributes = self.file.attrs.items()
                self.attributes = {name: as_python(value) for name, value in attributes}
                rows = {"frames": finished(self.file)}
                self._datasets = {
                    name: LazyArray(data, rows.get(name.partition("/")[0]))
                    for name, data in checked_datasets(self.file).items()
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
        """Return a dataset of node or point numbers. Raises InputError for numbers out of range."""
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
            return tomllib.loads(text)
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
        return W

    def body_of(self, group: str) -> Indices:
        """Return the body (n,) of each node ("lattice"), or (v,) of each point ("surface")."""
        if f"{group}/body" in self:
            return self[f"{group}/body"][:].astype(np.int64)
        points = "lattice/nodes" if group == "lattice" else "surface/points"
        return np.zeros(len(self[points]), np.int64)
