"""Arrays that may be on a GPU."""

import numpy as np


def is_here(array: np.ndarray) -> bool:
    """Whether it is in the memory of the CPU."""
    return isinstance(array, np.ndarray)


def fetch(array: np.ndarray) -> np.ndarray:
    """The same in the memory of the CPU; the very same if it is there."""
    return array if is_here(array) else array.get()


def beside(array: np.ndarray, values: np.ndarray) -> np.ndarray:
    """``values`` where the array is; the very same if they are there."""
    return fetch(values) if is_here(array) else np.asarray(values, like=array)


def greatest(array: np.ndarray) -> float:
    """The greatest of numbers that are not negative, 0 if there are none."""
    return float(array.max()) if array.size else 0.0
