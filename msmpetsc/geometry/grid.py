"""Uniform grids (paper section 4.1), a grid for each body: positions and indices of their cells."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows
from msmpetsc.errors import InputError
from msmpetsc.geometry.morton import LIMIT, SIDE_LIMIT
from msmpetsc.geometry.surface import SINGLE

PACK = np.array([LIMIT**2, LIMIT, 1])
# corners of a cell [cell]; in VTK's hexahedron order, as in the result file
CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
)
# triangles or cells in a batch [-]; bounds the memory of a pass
CHUNK = 1 << 17
# greatest shift of a coordinate onto a plane of the grid [cells]; far less than a cell.
# Along fewer than a thousand cells, SINGLE of the longest side limits the shift.
MOST_ON_PLANE = 1e-3


@dataclass(frozen=True)
class Grid:
    """A grid of cubes from ``origin`` (3,) [m] that covers a body.

    cell_size : side of a cell [m]
    shape     : (3,) number of cells along each axis
    """

    origin: Floats
    cell_size: float
    shape: Indices

    @classmethod
    def covering(cls, bounds: Rows, cell_size: float) -> "Grid":
        """Return the grid that starts at the low corner of ``bounds`` (2, 3) [m].

        Raises InputError if the cell size is too small to number the cells along an axis.
        """
        length = (bounds[1] - bounds[0]) / cell_size
        cells = np.ceil(length - min(SINGLE * length.max(), MOST_ON_PLANE))
        if not cells.max() < SIDE_LIMIT - 1:
            raise InputError(
                f"cages.cell_size: {cell_size:g} m would cut the body into {cells.max():.3g} cells "
                f"along one side, more than {SIDE_LIMIT - 2}"
            )
        return cls(bounds[0].copy(), float(cell_size), np.maximum(cells, 1).astype(np.int64))

    def to_cells(self, points: Positions) -> Rows:
        """Return points (..., 3) [m] in cell units, moved into the grid and onto near planes.

        The last cells along each axis own the grid's far faces.
        """
        inside = np.nextafter(self.shape.astype(float), 0)
        at = (points - self.origin) / self.cell_size
        plane = np.rint(at)
        is_on_plane = np.abs(at - plane) <= min(SINGLE * self.shape.max(), MOST_ON_PLANE)
        return np.clip(np.where(is_on_plane, plane, at), 0, inside)

    def node_positions(self, ijk: Array) -> Positions:
        """Return the positions [m] of grid nodes (..., 3)."""
        return self.origin + ijk * self.cell_size


@dataclass(frozen=True)
class BodyGrids:
    """Grids of several bodies with a common cell size, numbered as a single grid.

    The grid of body b is shifted by b times ``room`` cells along the first axis (README: cages).
    """

    grids: tuple[Grid, ...]

    @classmethod
    def covering(cls, bounds: Sequence[Rows], cell_size: float) -> "BodyGrids":
        """Return the grids of bodies with the bounding boxes ``bounds``, (2, 3) [m] each.

        Raises InputError if the cell size is too small to number the cells.
        """
        grids = cls(tuple(Grid.covering(box, cell_size) for box in bounds))
        if grids.room * len(bounds) > LIMIT:
            raise InputError(
                f"cages.cell_size: {cell_size:g} m is too small to number the cells of "
                f"{len(bounds)} bodies: use at most {LIMIT // len(bounds) // 4} cells along a side"
            )
        return grids

    @property
    def cell_size(self) -> float:
        """Side of a cell [m]."""
        return self.grids[0].cell_size

    @cached_property
    def room(self) -> int:
        """Cells reserved for each body along the first axis; 0 for a single body, without limit."""
        longest = max(int(grid.shape.max()) for grid in self.grids)
        return 2 << longest.bit_length() if len(self.grids) > 1 else 0

    @cached_property
    def _origins(self) -> Indices:
        return np.array([grid.origin for grid in self.grids])

    def first(self, body: int | Indices) -> Indices:
        """Return the grid index (..., 3) of a body's first cell."""
        first: Indices = np.asarray(body)[..., None] * np.array([self.room, 0, 0])
        return first

    def body_of(self, ijk: Indices) -> Indices:
        """Return the body number (...,) of grid indices (..., 3)."""
        if not self.room:
            return np.zeros(ijk.shape[:-1], np.int64)
        body: Indices = (ijk[..., 0] // self.room).astype(np.int64)
        return body

    def node_positions(self, ijk: Array) -> Positions:
        """Return the positions [m] of grid nodes (..., 3), or of points between nodes."""
        body = self.body_of(ijk)
        return self._origins[body] + (ijk - self.first(body)) * self.cell_size


def packed(ijk: Indices) -> Indices:
    """Return a key (n,) for each grid index (n, 3); keys sort as (i, j, k) does."""
    keys: Indices = ijk @ PACK
    return keys


def unpacked(keys: Indices) -> Indices:
    """Return the grid index (n, 3) of each key of ``packed``."""
    return np.stack([keys // PACK[0], keys // PACK[1] % LIMIT, keys % LIMIT], axis=1)
