"""Types of arrays in signatures, and functions for arrays on either device."""

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

# numbers of any type
Array: TypeAlias = npt.NDArray[Any]
# (n,) a number per node, spring, cell or point
Floats: TypeAlias = npt.NDArray[np.float64]
# (n, 3) [m]
Positions: TypeAlias = npt.NDArray[np.float64]
# (n, k) forces, velocities, normals or blocks
Rows: TypeAlias = npt.NDArray[np.float64]
# numbers of nodes, springs, cells, points or triangles
Indices: TypeAlias = npt.NDArray[np.signedinteger[Any]]
# (n,) selection of nodes, springs, cells or points
Mask: TypeAlias = npt.NDArray[np.bool_]


def on_host(array: Array) -> bool:
    """Return whether an array is in CPU memory."""
    return isinstance(array, np.ndarray)


def to_host(array: Array) -> Array:
    """Return an array in CPU memory; the same object if it is there already."""
    return array if on_host(array) else array.get()  # type: ignore[attr-defined]  # CuPy's


def like(array: Array, values: Array) -> Array:
    """Return ``values`` on the device of ``array``; the same object if it is there already."""
    return to_host(values) if on_host(array) else np.asarray(values, like=array)


def greatest(array: Array) -> float:
    """Return the maximum of non-negative numbers; 0 for an empty array."""
    return float(array.max()) if array.size else 0.0
