"""Arrays of a file, read where they are indexed: by numpy's rules, or through xarray."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import h5py
import numpy as np

from msmpetsc.backend.arrays import Array
from msmpetsc.errors import InputError, one_line


class LazyArray:
    """A dataset that is read by indexing, as numpy's arrays are: ``array[-1]``, ``array[:, 17]``, ``np.diff(array)``.

    Frames end with the finished ones. One index may be a list or an array; each takes its rows one by one.

    name    : of the dataset in the file, "frames/position"
    planned : shape of the dataset in the file, frames to come included
    """

    def __init__(self, dataset: h5py.Dataset, count: int | None = None):
        """Wrap a dataset; count: its rows that can be read, all if None."""
        self._dataset = dataset
        self._file, self.name = dataset.file.filename, dataset.name.lstrip("/")
        self._by_row = count is not None
        self.planned: tuple[int, ...] = dataset.shape
        self.shape: tuple[int, ...] = (len(dataset) if count is None else count, *dataset.shape[1:])
        self.dtype = dataset.dtype
        unit = dataset.attrs.get("unit", "1")
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
        keys = _key_per_axis(key, self.ndim)
        arrays = [k for k in keys if not isinstance(k, int | np.integer | slice)]
        if len(arrays) > 1:
            raise IndexError(f"{self.name}: a list or an array may stand for one axis only")
        if not arrays:
            return self._read(keys)
        if not self._by_row:
            whole: Array = self[:][keys]
            return whole
        return self._read_rows(keys)

    def _read_rows(self, keys: tuple[Any, ...]) -> Array:
        """Read with a list or an array among the keys: row by row, for all together may be more than fits."""
        first, rest = keys[0], keys[1:]
        rows = np.arange(len(self))[first]
        if not rows.size:
            empty: Array = np.broadcast_to(np.zeros((), self.dtype), self.shape)[keys]  # its shape alone
            return empty
        if np.ndim(first):
            values = np.array([self._read((row, *rest)) for row in rows.flat])
        else:
            values = np.array([self[int(row)][rest] for row in rows.flat])
        return values.reshape(*rows.shape, *values.shape[1:])

    def _read(self, keys: tuple[Any, ...]) -> Array:
        """Read with numbers and slices for keys."""
        parts: list[int | range] = [
            range(size)[int(k) if isinstance(k, np.integer) else k] for k, size in zip(keys, self.shape, strict=True)
        ]
        if not self._dataset:
            raise InputError(f"{self._file} is closed")
        try:
            values: Array = self._dataset[tuple(map(_forward, parts))]
        except (OSError, RuntimeError, MemoryError) as error:
            raise InputError(f"{self._file}: {self.name} cannot be read: {one_line(error)}") from error
        turned = [axis for axis, part in enumerate(part for part in parts if isinstance(part, range)) if part.step < 0]
        return np.flip(values, turned) if turned else values


class Arrays(Mapping[str, LazyArray]):
    """The arrays of one group by their names: ``frames["time"]`` or ``frames.time``."""

    def __init__(self, group: str, arrays: dict[str, LazyArray]):
        self._group, self._arrays = group, arrays

    def __getitem__(self, name: str) -> LazyArray:
        return self._arrays[name]

    def __getattr__(self, name: str) -> LazyArray:
        if name.startswith("_") or name not in self._arrays:
            raise AttributeError(f"no {self._group}/{name} in this file, but {', '.join(self._arrays) or 'nothing'}")
        return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self._arrays]

    def __repr__(self) -> str:
        return "\n".join([self._group, *map("  {!r}".format, self._arrays.values())])


def _key_per_axis(key: Any, ndim: int) -> tuple[Any, ...]:
    """Return the key with its ... and what is left out written as slices."""
    keys = list(key) if isinstance(key, tuple) else [key]
    dots = [axis for axis, k in enumerate(keys) if k is Ellipsis]
    missing = ndim - len(keys) + len(dots)
    if missing < 0 or len(dots) > 1 or any(k is None for k in keys):
        raise IndexError(f"{ndim} axes cannot be indexed with {key!r}")
    axis = dots[0] if dots else len(keys)
    return (*keys[:axis], *[slice(None)] * missing, *keys[axis + len(dots) :])


def _forward(part: int | range) -> int | slice:
    """Return the index for h5py, whose slices only go up."""
    if isinstance(part, int):
        return part
    part = part if part.step > 0 else part[::-1]
    return slice(part.start, part.stop, part.step) if len(part) else slice(0, 0)


def xarray_variable(dimensions: Sequence[str], array: LazyArray, long_name: str) -> Any:
    """Return an xarray.Variable that reads the array where it is used, as xarray's own readers of files do it."""
    import xarray
    from xarray.backends import BackendArray
    from xarray.core import indexing

    class ArrayOfResult(BackendArray):
        shape, dtype = array.shape, array.dtype

        def __getitem__(self, key: Any) -> Any:
            basic = indexing.IndexingSupport.BASIC
            return indexing.explicit_indexing_adapter(key, self.shape, basic, array.__getitem__)

    data = indexing.LazilyIndexedArray(ArrayOfResult())
    return xarray.Variable(dimensions, data, {"long_name": long_name, "units": array.unit})
