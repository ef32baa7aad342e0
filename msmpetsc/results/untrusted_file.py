"""Open a result file without trusting it: a file may claim anything.

All claims are checked when the file is opened, before any array is read. The functions raise an
InputError of a single line for a hostile or damaged file.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from msmpetsc.errors import InputError, one_line, printable
from msmpetsc.fields import FIELDS
from msmpetsc.results.disk import refuse_no_file

FORMAT, FORMAT_VERSION = "msmpetsc", 1
NEEDED = ("lattice/nodes", "frames/time", "frames/position")
# largest compression ratio of zlib [-]
DEFLATE_MOST = 1032


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


def finished(file: h5py.File) -> int:
    """Return the number of finished frames: frames with a finite time."""
    has_time = np.isfinite(file["frames/time"][:])
    return int(np.argmin(np.append(has_time, False)))


def _check_is_result(path: Path, file: h5py.File) -> None:
    """Raise InputError unless a file has the format, the version and the frames of a result."""
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
    checked_dataset(path, file, "frames/time")


@contextmanager
def plain_damage(path: Path) -> Iterator[None]:
    """Turn errors of HDF5 and h5py on damaged files into an InputError of a single line."""
    try:
        yield
    except PermissionError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
    except KeyError as error:
        # HDF5 tells a damaged object in a sentence
        reason = printable(str(error.args[0]))
        told = " or cut short: " if " " in reason else ": it has no "
        raise InputError(f"{path} is damaged{told}{reason}") from error
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
    datasets = {
        name: checked_dataset(path, file, name)
        for name in FIELDS
        if name in NEEDED or object_at(path, file, name) is not None
    }
    _check_sizes(path, datasets, finished(file))
    return datasets


def _check_sizes(path: Path, datasets: dict[str, h5py.Dataset], count: int) -> None:
    """Raise InputError if datasets disagree about a common size, or have too few frames."""
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
    field = FIELDS[name]
    kinds = "f" if field.dtype.startswith("f") else "iu"
    if dataset.dtype.kind not in kinds or dataset.ndim != len(field.shape):
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
