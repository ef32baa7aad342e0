"""Trees of connected items, each item with the number of its parent (union-find)."""

from msmpetsc.backend.arrays import Indices
from msmpetsc.backend.kernel import njit


@njit()
def root(parent: Indices, item: int) -> int:
    """Return the root of an item's tree, and halve the path to the root."""
    while parent[item] != item:
        parent[item] = parent[parent[item]]
        item = parent[item]
    return item
