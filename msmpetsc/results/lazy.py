"""Arrays of a file that are read when they are indexed, as h5py's datasets are."""

from collections.abc import Iterator, Mapping
from typing import Any

import h5py
import numpy as np

from msmpetsc.backend.arrays import Array
from msmpetsc.errors import InputError, one_line


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
            raise IndexError(f"{self.name} cannot be indexed with {key!r}: {one_line(error)}") from error
        except (OSError, RuntimeError, MemoryError) as error:
            raise InputError(f"{self._file}: {self.name} cannot be read: {one_line(error)}") from error
        return values


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
