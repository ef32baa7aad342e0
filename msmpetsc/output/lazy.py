"""Arrays of a file, read where they are indexed."""

from collections.abc import Iterator, Mapping

import h5py
import numpy as np

from msmpetsc.errors import InputError, one_line


class LazyArray:
    """A dataset that is read by indexing, as numpy's arrays are: ``array[-1]``, ``array[:, 17]``, ``np.diff(array)``.

    Of frames only the finished ones are there. One index may be a list or an array; each takes its rows one by one.
    """

    def __init__(self, dataset: h5py.Dataset, count: int | None = None):
        """count: rows that are there, all if None."""
        self._dataset = dataset
        self._file, self._name = dataset.file.filename, dataset.name.lstrip("/")
        self._by_row = count is not None
        self.shape = (len(dataset) if count is None else count, *dataset.shape[1:])
        self.dtype = dataset.dtype
        unit = dataset.attrs.get("unit", "1")
        self.unit = unit if isinstance(unit, str) else "1"

    @property
    def ndim(self) -> int:
        return len(self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self[row] for row in range(len(self)))

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return np.asarray(self[:], dtype)

    def __repr__(self) -> str:
        return f"<{self._name} {self.shape} {self.dtype} [{self.unit}]>"

    def __getitem__(self, key) -> np.ndarray:
        keys = _one_an_axis(key, self.ndim)
        arrays = [k for k in keys if not isinstance(k, int | np.integer | slice)]
        if len(arrays) > 1:
            raise IndexError(f"{self._name}: a list or an array may stand for one axis only")
        if not arrays:
            return self._read(keys)
        if not self._by_row:
            return self[:][keys]
        return self._read_rows(keys)

    def _read_rows(self, keys: tuple) -> np.ndarray:
        """A list or an array among the keys: row by row, for all of them together may be more than fits."""
        first, rest = keys[0], keys[1:]
        rows = np.arange(len(self))[first]
        one = (lambda row: self._read((row, *rest))) if np.ndim(first) else (lambda row: self[int(row)][rest])
        if not rows.size:
            return np.broadcast_to(np.zeros((), self.dtype), self.shape)[keys]  # its shape alone
        found = np.array([one(row) for row in rows.flat])
        return found.reshape(*rows.shape, *found.shape[1:])

    def _read(self, keys: tuple) -> np.ndarray:
        """The keys are numbers and slices."""
        parts = [range(size)[int(k) if isinstance(k, np.integer) else k] for k, size in zip(keys, self.shape)]
        if not self._dataset:
            raise InputError(f"{self._file} is closed")
        try:
            found = self._dataset[tuple(map(_forward, parts))]
        except (OSError, RuntimeError, MemoryError) as error:
            raise InputError(f"{self._file}: {self._name} cannot be read: {one_line(error)}") from error
        ranges = [part for part in parts if isinstance(part, range)]
        return found[tuple(slice(None, None, -1 if part.step < 0 else 1) for part in ranges)] if ranges else found


class Arrays(Mapping):
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


def _one_an_axis(key, ndim: int) -> tuple:
    """The key with its ... and what is left out written as slices."""
    keys = list(key) if isinstance(key, tuple) else [key]
    dots = [place for place, k in enumerate(keys) if k is Ellipsis]
    missing = ndim - len(keys) + len(dots)
    if missing < 0 or len(dots) > 1 or any(k is None for k in keys):
        raise IndexError(f"{ndim} axes cannot be indexed with {key!r}")
    place = dots[0] if dots else len(keys)
    return (*keys[:place], *[slice(None)] * missing, *keys[place + len(dots) :])


def _forward(part: int | range) -> int | slice:
    """For h5py, whose slices only go up."""
    if isinstance(part, int):
        return part
    part = part if part.step > 0 else part[::-1]
    return slice(part.start, part.stop, part.step) if len(part) else slice(0, 0)
