"""Arrays that may be on a GPU."""

import numpy as np


def on_host(array: np.ndarray) -> bool:
    """Return whether an array is in the memory of the CPU."""
    return isinstance(array, np.ndarray)


def to_host(array: np.ndarray) -> np.ndarray:
    """Return an array in the memory of the CPU; the very same if it already is."""
    return array if on_host(array) else array.get()  # type: ignore[attr-defined]  # CuPy's


def like(array: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return ``values`` in the memory that ``array`` is in; the very same if they already are."""
    return to_host(values) if on_host(array) else np.asarray(values, like=array)


def greatest(array: np.ndarray) -> float:
    """Return the greatest of numbers that are not negative, 0 if there are none."""
    return float(array.max()) if array.size else 0.0
