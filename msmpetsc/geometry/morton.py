"""Morton order: keys of grid indices that interleave the bits of i, j and k.

Cells and nodes near in space have near keys, so a range of keys is compact. The lowest bits of a
key number the copies of a cell or node at the same grid index (geometry.copies).
"""

import numpy as np

from msmpetsc.backend.arrays import Indices
from msmpetsc.backend.kernel import njit

# bits of a key for the number of a copy [-]; a key has 63 bits, and the indices take 61
COPY_BITS = 2
# copies at a grid index [-]
COPIES = 1 << COPY_BITS
# most cells along the first axis [-]; 21 bits of a key
LIMIT = 1 << 21
# most cells along the longest side of a body [-]; 20 bits of a key
SIDE_LIMIT = LIMIT >> 1


@njit()
def _spread(x: int) -> int:
    """Return the bits of x with two zero bits between neighbours."""
    x &= 0x1FFFFF
    x = (x | x << 32) & 0x1F00000000FFFF
    x = (x | x << 16) & 0x1F0000FF0000FF
    x = (x | x << 8) & 0x100F00F00F00F00F
    x = (x | x << 4) & 0x10C30C30C30C30C3
    return (x | x << 2) & 0x1249249249249249


@njit()
def _gather(x: int) -> int:
    """Return the inverse of ``_spread``."""
    x &= 0x1249249249249249
    x = (x | x >> 2) & 0x10C30C30C30C30C3
    x = (x | x >> 4) & 0x100F00F00F00F00F
    x = (x | x >> 8) & 0x1F0000FF0000FF
    x = (x | x >> 16) & 0x1F00000000FFFF
    return (x | x >> 32) & 0x1FFFFF


@njit()
def _encode(ijk: Indices, keys: Indices) -> None:
    """Set the Morton keys (n,) of grid indices (n, 3); -1 for an index without a key."""
    for n in range(len(ijk)):
        i, j, k = ijk[n]
        keys[n] = -1
        if 0 <= i < LIMIT and 0 <= j < SIDE_LIMIT and 0 <= k < SIDE_LIMIT:
            keys[n] = (_spread(i) | _spread(j) << 1 | _spread(k) << 2) << COPY_BITS


@njit()
def _decode(keys: Indices, ijk: Indices) -> None:
    """Set the grid indices (n, 3) of Morton keys (n,)."""
    for n in range(len(keys)):
        bits = keys[n] >> COPY_BITS
        ijk[n, 0] = _gather(bits)
        ijk[n, 1] = _gather(bits >> 1)
        ijk[n, 2] = _gather(bits >> 2)


def encode_morton(ijk: Indices) -> Indices:
    """Return the Morton key (...,) of copy 0 at each grid index (..., 3).

    It is -1 outside 0..LIMIT - 1 along the first axis, and 0..SIDE_LIMIT - 1 along the others.
    """
    rows = np.ascontiguousarray(ijk, np.int64).reshape(-1, 3)
    keys = np.empty(len(rows), np.int64)
    _encode(rows, keys)
    return keys.reshape(np.shape(ijk)[:-1])


def decode_morton(keys: Indices) -> Indices:
    """Return the grid index (..., 3) of each Morton key (...,)."""
    flat = np.ascontiguousarray(keys, np.int64).reshape(-1)
    ijk = np.empty((len(flat), 3), np.int64)
    _decode(flat, ijk)
    return ijk.reshape(*np.shape(keys), 3)
