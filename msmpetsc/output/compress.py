"""A finished result file, packed: gzip over shuffled bytes, row by row as before, so that a frame is still read alone.

Not while it is written: chunks of packed sizes have no places set aside, and a kill could spoil the file.
"""

import os
from pathlib import Path

import h5py
import numpy as np

from msmpetsc.errors import InputError, one_line
from msmpetsc.output.reader import DEFLATE_MOST
from msmpetsc.output.writer import open_new, pieces, plain_errors

PACKED = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
LEAST = 4096  # [byte]: what is shorter is not worth a filter


def pack(path: Path) -> None:
    """Replace the file by its packed self, when that is whole. Raises InputError; the file then is as it was."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with plain_errors(part), h5py.File(path, "r", locking=False) as file, open_new(part) as packed:
            packed.attrs.update(file.attrs)
            file.visititems(lambda name, found: _copy(name, found, packed))
        os.replace(part, path)
    except InputError:
        part.unlink(missing_ok=True)
        raise
    except (RuntimeError, KeyError, ValueError, TypeError) as error:
        part.unlink(missing_ok=True)
        raise InputError(f"{path} is damaged: {one_line(error)}") from error


def _copy(name: str, found: h5py.Group | h5py.Dataset, packed: h5py.File) -> None:
    if isinstance(found, h5py.Group):
        packed.require_group(name).attrs.update(found.attrs)
        return
    if found.nbytes > found.file.id.get_filesize() * (DEFLATE_MOST if found.compression else 1):
        raise ValueError(f"{name} claims more than the file holds")
    filters = PACKED if found.nbytes > LEAST else {}
    copy = packed.create_dataset(name, found.shape, found.dtype, chunks=_chunks(found) if filters else None, **filters)
    copy.attrs.update(found.attrs)
    if not filters:
        copy[...] = found[...]
        return
    frames = found.ndim == 3  # or rows that do not change with time
    row = np.empty((0, *found.shape[2 if frames else 1 :]), found.dtype)
    for index in range(len(found)) if frames else (None,):
        for part in pieces(row, found.shape[1] if frames else len(found)):
            place = (index, part) if frames else part
            copy[place] = found[place]


def _chunks(found: h5py.Dataset) -> tuple[int, ...] | bool:
    """Those of the file, which hold no more than one frame; h5py's own for what had none."""
    return found.chunks or True
