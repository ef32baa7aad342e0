"""Arrays that may be on a GPU."""

import numpy as np


def on_host(array: np.ndarray) -> bool:
    """Whether it is in the memory of the CPU."""
    return isinstance(array, np.ndarray)


def to_host(array: np.ndarray) -> np.ndarray:
    """The same in the memory of the CPU; the very same if it is there."""
    return array if on_host(array) else array.get()


def like(array: np.ndarray, values: np.ndarray) -> np.ndarray:
    """``values`` where the array is; the very same if they are there."""
    return to_host(values) if on_host(array) else np.asarray(values, like=array)


def greatest(array: np.ndarray) -> float:
    """The greatest of numbers that are not negative, 0 if there are none."""
    return float(array.max()) if array.size else 0.0
