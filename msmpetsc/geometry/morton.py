"""Morton order: grid cells and nodes near in space are near in number, so a contiguous range is compact."""

import numba
import numpy as np

BITS = 21  # an axis: three of them fill 63 bits of a key
LIMIT = 1 << BITS


@numba.vectorize(["int64(int64)"], cache=True)
def _spread(x):
    """The bits of x with two zeros between each two."""
    x &= 0x1FFFFF
    x = (x | x << 32) & 0x1F00000000FFFF
    x = (x | x << 16) & 0x1F0000FF0000FF
    x = (x | x << 8) & 0x100F00F00F00F00F
    x = (x | x << 4) & 0x10C30C30C30C30C3
    return (x | x << 2) & 0x1249249249249249


@numba.vectorize(["int64(int64)"], cache=True)
def _gather(x):
    """Inverse of ``_spread``."""
    x &= 0x1249249249249249
    x = (x | x >> 2) & 0x10C30C30C30C30C3
    x = (x | x >> 4) & 0x100F00F00F00F00F
    x = (x | x >> 8) & 0x1F0000FF0000FF
    x = (x | x >> 16) & 0x1F00000000FFFF
    return (x | x >> 32) & 0x1FFFFF


def encode(ijk: np.ndarray) -> np.ndarray:
    """Key of each grid index: (..., 3) int -> (...,) int64; -1 where an index is outside 0..2^21 - 1."""
    ijk = np.asarray(ijk, np.int64)
    key = _spread(ijk[..., 0]) | _spread(ijk[..., 1]) << 1 | _spread(ijk[..., 2]) << 2
    return np.where(((ijk >= 0) & (ijk < LIMIT)).all(axis=-1), key, -1)


def decode(keys: np.ndarray) -> np.ndarray:
    """Grid index of each key: (...,) int64 -> (..., 3) int64."""
    keys = np.asarray(keys, np.int64)
    return np.stack([_gather(keys), _gather(keys >> 1), _gather(keys >> 2)], axis=-1)
