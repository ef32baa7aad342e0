"""The uniform grid that a surface is laid into (paper section 4.1)."""

from dataclasses import dataclass

import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.geometry.morton import LIMIT

SAME = 1e-9  # cells: a body that is this close to a whole number of cells long has that number


@dataclass(frozen=True)
class Grid:
    """Cubes of side ``cell_size`` [m] from ``origin`` (3,) [m]; ``shape`` (3,) of them cover the body."""

    origin: np.ndarray
    cell_size: float
    shape: np.ndarray

    @classmethod
    def covering(cls, bounds: np.ndarray, cell_size: float) -> "Grid":
        """The grid that starts at the low corner of ``bounds`` (2, 3) [m].

        Raises InputError for a cell size too small to number the cells along an axis.
        """
        cells = np.ceil((bounds[1] - bounds[0]) / cell_size - SAME)
        if not cells.max() < LIMIT - 1:
            raise InputError(
                f"cages.cell_size: {cell_size:g} m would cut the body into {cells.max():.3g} cells along one side, "
                f"more than {LIMIT - 2}"
            )
        return cls(bounds[0].copy(), float(cell_size), np.maximum(cells, 1).astype(np.int64))

    def to_cells(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) [m] in units of cells, kept within the grid: its last cells own its far faces."""
        inside = np.nextafter(self.shape.astype(float), 0)
        return np.clip((points - self.origin) / self.cell_size, 0, inside)

    def node_positions(self, ijk: np.ndarray) -> np.ndarray:
        """Positions [m] of grid nodes (..., 3)."""
        return self.origin + ijk * self.cell_size

    def nearest_nodes(self, points: np.ndarray) -> np.ndarray:
        """Grid index (..., 3) of the nodes nearest to points (..., 3) [m]."""
        return np.rint((points - self.origin) / self.cell_size).astype(np.int64)
