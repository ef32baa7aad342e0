"""A finished result file, packed: gzip over shuffled bytes, row by row as before, so that a frame is still read alone.

It is not packed while it is written: chunks of packed sizes have no room set aside, and a kill could spoil the file.
"""

from pathlib import Path

import h5py

from msmpetsc.errors import InputError, one_line
from msmpetsc.output.disk import Storage, whole_file
from msmpetsc.output.layout import open_new
from msmpetsc.output.reader import DEFLATE_MOST, open_result
from msmpetsc.output.transfer import pieces

PACKED = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
LEAST = 4096  # [byte]: what is shorter is not worth a filter


def pack(path: Path) -> None:
    """Replace the file by its packed self once that is whole. Raises InputError, and then the file is as it was."""
    try:
        with (
            whole_file(path) as part,
            open_result(path) as file,
            Storage(part, "w+") as storage,
            storage.telling(),  # when it is closed
            open_new(storage) as packed,
        ):
            packed.attrs.update(file.attrs)
            file.visititems(lambda name, source: _copy(name, source, packed))
    except (RuntimeError, KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path} is damaged: {one_line(error)}") from error


def _copy(name: str, source: h5py.Group | h5py.Dataset, packed: h5py.File) -> None:
    """Write a group or a dataset of the file, with its attributes, into the packed one."""
    if isinstance(source, h5py.Group):
        packed.require_group(name).attrs.update(source.attrs)
        return
    if source.nbytes > source.file.id.get_filesize() * (DEFLATE_MOST if source.compression else 1):
        raise ValueError(f"{name} claims more than the file holds")
    filters = PACKED if source.nbytes > LEAST else {}
    # the chunks of the file hold no more than one frame; h5py chooses them for what has none
    chunks = (source.chunks or True) if filters else None
    copy = packed.create_dataset(name, source.shape, source.dtype, chunks=chunks, **filters)
    copy.attrs.update(source.attrs)
    if not filters:
        copy[...] = source[...]
        return
    is_series = source.ndim == 3  # else its rows do not change with time
    rows = source.shape[1] if is_series else len(source)
    for index in range(len(source)) if is_series else (None,):
        for part in pieces(rows, source.dtype, source.shape[2 if is_series else 1 :]):
            key = (index, part) if is_series else part
            copy[key] = source[key]
