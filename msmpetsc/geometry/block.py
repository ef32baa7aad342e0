"""The 3x3x3 cells and 4x4x4 nodes around a cell: their numbering, and the blend over the cell's corners.

Lengths are in units of the cell size, with the cell's low corner at 0. Cell (x,y,z), each 0..2, of the block is
entry 9x + 3y + z and lies at offset (x-1, y-1, z-1): the cell itself is 13. Node (x,y,z), each 0..3, is entry
16x + 4y + z at offset (x-1, y-1, z-1). Corner v = 0..7 of the cell has the bits (v>>2 & 1, v>>1 & 1, v & 1).
"""

import numba

ITSELF = 13  # entry of the cell among its 27


@numba.njit(cache=True)
def corner_bit(v, axis):
    """Coordinate, 0 or 1, of corner v along an axis."""
    return (v >> (2 - axis)) & 1


@numba.njit(cache=True)
def corner_node(v):
    """Entry of corner v among the 64 nodes."""
    return 16 * (1 + corner_bit(v, 0)) + 4 * (1 + corner_bit(v, 1)) + 1 + corner_bit(v, 2)


@numba.njit(cache=True)
def cells_around(v, valid):
    """Which of the 8 cells around corner v are valid: bit 4i + 2j + k for the cell at (i,j,k) in {0,1}^3."""
    first = 9 * corner_bit(v, 0) + 3 * corner_bit(v, 1) + corner_bit(v, 2)
    mask = 0
    for bit in range(8):
        if valid[first + 9 * corner_bit(bit, 0) + 3 * corner_bit(bit, 1) + corner_bit(bit, 2)]:
            mask |= 1 << bit
    return mask


@numba.njit(cache=True)
def smoothstep(z):
    """z^2 (3 - 2z) on [0,1], constant beyond: its slope is 0 at both ends."""
    z = min(max(z, 0.0), 1.0)
    return z * z * (3.0 - 2.0 * z)


@numba.njit(cache=True)
def corner_blend(v, u):
    """W(v, p) of Eq. 8: product over the axes of smoothstep(1 - distance to v). Sums to 1 over the 8 corners.

    On a face of the cell only its 4 corners count, and no W changes along the face's normal: two cells that share
    the face and agree on what a corner says (L_v of Eq. 8) therefore agree in position and in slope.
    """
    product = 1.0
    for axis in range(3):
        product *= smoothstep(u[axis] if corner_bit(v, axis) else 1.0 - u[axis])
    return product
