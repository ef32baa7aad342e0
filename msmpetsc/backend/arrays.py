"""Arrays, which may be on a GPU: the types that signatures name, and what works wherever they are."""

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[Any]  # of any numbers
Floats: TypeAlias = npt.NDArray[np.float64]  # (n,) one number a node, spring, cell or point
Positions: TypeAlias = npt.NDArray[np.float64]  # (n, 3) [m]
Rows: TypeAlias = npt.NDArray[np.float64]  # (n, k) other rows: forces, velocities, normals, blocks
Indices: TypeAlias = npt.NDArray[
    np.signedinteger[Any]
]  # numbers of nodes, springs, cells, points, triangles
Mask: TypeAlias = npt.NDArray[np.bool_]  # (n,) which of them


def on_host(array: Array) -> bool:
    """Return whether an array is in the memory of the CPU."""
    return isinstance(array, np.ndarray)


def to_host(array: Array) -> Array:
    """Return an array in the memory of the CPU; the very same if it already is."""
    return array if on_host(array) else array.get()  # type: ignore[attr-defined]  # CuPy's


def like(array: Array, values: Array) -> Array:
    """Return ``values`` in the memory that ``array`` is in; the very same if they already are."""
    return to_host(values) if on_host(array) else np.asarray(values, like=array)


def greatest(array: Array) -> float:
    """Return the greatest of numbers that are not negative, 0 if there are none."""
    return float(array.max()) if array.size else 0.0
