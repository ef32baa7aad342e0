"""Samples of the part of each cell inside the surface, and moments weighted at the samples."""

from collections.abc import Iterator

import numpy as np

from msmpetsc.backend.arrays import Indices, Rows
from msmpetsc.geometry.cages import LEAST_FILL, Cages
from msmpetsc.geometry.grid import CHUNK, CORNERS
from msmpetsc.geometry.morton import decode_morton
from msmpetsc.lattice.cell_moments import forms_of

# samples of a cell [-]
COUNT = 64
# samples (s, 3) of a whole cell from its middle [cells]; a lattice rule with 64 values
# along each axis. The share beyond a plane errs by 1.5% rms. For a plane along the grid
# it errs by 0.8% at most, but by 12% with a grid of 4^3 samples.
OF_WHOLE = (np.arange(COUNT)[:, None] * [1, 7, 23] % COUNT + 0.5) / COUNT - 0.5
# farthest place of a sample along an axis from the middle of a cell [cells]
MOST = float(OF_WHOLE.max())


class CellSamples:
    """Samples of cells; in a cut cell they have centroid and covariance of the part inside.

    Samples that would leave their cell are moved back to its side.

    ijk     : (c, 3) grid index of the cells
    body    : (c,) number of their bodies
    fills   : (c, 8) fills of their corners (geometry.fill_fractions)
    moments : (c, 3) second moments about their middles
    """

    def __init__(self, cages: Cages, keys: Indices):
        """Read the fills and moments of the cells with these keys (c,) (collective)."""
        self._grids = cages.grids
        self.ijk = decode_morton(keys)
        self.body = cages.grids.body_of(self.ijk)
        self.fills, self.moments = cages.materials_of(keys)
        # centroid (c, 3) from the middle [cells], and square root (c, 3, 3) of 12 times
        # the covariance
        self._centroid = np.zeros((len(keys), 3))
        self._root = np.broadcast_to(np.eye(3), (len(keys), 3, 3)).copy()
        cut = self.cut(np.arange(len(keys)))
        forms = forms_of(self.fills[cut], self.moments[cut])
        self._centroid[cut] = forms[:, :3] / 2
        covariance = np.zeros((len(cut), 3, 3))
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            covariance[:, k, k] = forms[:, 6 + k] / 4
            covariance[:, i, j] = covariance[:, j, i] = forms[:, 9 + k] / 4
        values, vectors = np.linalg.eigh(12 * covariance)
        scaled = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        self._root[cut] = scaled @ vectors.transpose(0, 2, 1)

    def cut(self, rows: Indices) -> Indices:
        """Return the cells among ``rows`` (k,) that the surface cuts."""
        cut: Indices = rows[self.fills[rows].min(axis=1, initial=1) < 1]
        return cut

    def places(self, rows: Indices) -> Rows:
        """Return the samples (k, s, 3) of cells (k,) from their middles [cells]."""
        places = self._centroid[rows, None] + OF_WHOLE @ self._root[rows]
        # beyond a face of the cell may be another material
        inside: Rows = places.clip(-MOST, MOST)
        return inside

    def points(self, rows: Indices) -> Iterator[tuple[Indices, Rows]]:
        """Yield chunks (k,) of the cells ``rows`` (c,), and their samples (k * s, 3) [m]."""
        step = CHUNK // COUNT
        for start in range(0, len(rows), step):
            chunk = rows[start : start + step]
            places = self.ijk[chunk, None] + 0.5 + self.places(chunk)
            yield chunk, self._grids.node_positions(places.reshape(-1, 3))

    def weighted(self, rows: Indices, weights: Rows) -> tuple[Rows, Rows]:
        """Return fills (k, 8) and moments (k, 3) of cells (k,), weighted by w at the samples.

        The mean fill of a cell does not change. With w = 1 fills and moments are exact.

        weights : (k, s) share of each sample times w - 1
        """
        places = self.places(rows)[:, :, None]
        linear = np.where(CORNERS == 1, 0.5 + places, 0.5 - places).prod(axis=3)
        squares = places[:, :, 0] ** 2
        fills, moments = self.fills[rows], self.moments[rows]
        volume = fills.mean(axis=1, keepdims=True)
        change = 8 * volume * np.einsum("cs,csv->cv", weights, linear)
        weighted = np.maximum(fills + change, LEAST_FILL)
        weighted *= volume / weighted.mean(axis=1, keepdims=True)
        return weighted, moments + volume * np.einsum("cs,csk->ck", weights, squares)
