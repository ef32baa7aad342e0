"""Stress of a neo-Hookean solid, in each cell and at each node.

F is the mean deformation gradient of a cell, J = det F, and U is defined in elasticity.neo_hookean.
The first Piola-Kirchhoff and the Cauchy stress are (Bonet and Wood 2008, chapter 5)

    P = mu F + U' cof F,        sigma = P F^T / J = mu / J F F^T + U' I.

The pressure is p = -tr(sigma) / 3, and von Mises' stress is (3/2 |sigma + p I|^2)^(1/2). The stress
at a node is the mean over the cells around the node, weighted by their volume at rest. In nearly
incompressible solids prefer the stress at nodes, because pressure may alternate from cell to cell.
"""

from typing import Any

import numpy as np
from scipy.sparse import csr_array

from msmpetsc.backend.arrays import Floats, Positions, Rows, to_host
from msmpetsc.elasticity.cell_blocks import STATE
from msmpetsc.elasticity.cell_strain import LANES
from msmpetsc.elasticity.cell_threads import cell_changes
from msmpetsc.elasticity.neo_hookean import ONSET
from msmpetsc.elasticity.solid import NeoHookean
from msmpetsc.lattice.lattice import Lattice

# indices of xx, yy, zz, xy, yz, xz among nine entries [-]; the result file's order
UPPER = np.array([0, 4, 8, 1, 5, 2])


class StressField:
    """The stress fields of a frame (fields.Frame), for this rank's part of a lattice.

    around : (owned, d) sparse matrix, weights of the cells around each node; rows sum to 1
    """

    def __init__(self, lattice: Lattice, solid: NeoHookean):
        assert lattice.solid is not None
        self.solid, self.cells, self.cells_owned = solid, lattice.solid, lattice.cells_owned
        self.rest = lattice.nodes
        corners = to_host(lattice.local_cells)
        weights, number = np.repeat(self.cells.volume, 8), np.repeat(np.arange(len(corners)), 8)
        around = csr_array(
            (weights, (corners.ravel(), number)), shape=(len(lattice.nodes), len(corners))
        )
        self.around = around[: lattice.owned]
        self.around.data /= np.repeat(self.around.sum(axis=1), np.diff(self.around.indptr))

    def __call__(self, q: Positions) -> dict[str, Any]:
        """Return the fields at q (l, 3) [m] of owned nodes, and as ``cell_...`` of owned cells.

        A stress is a row (6,) of xx, yy, zz, xy, yz, xz [Pa]. Strain energies are [J/m^3] of volume
        at rest. The factor 1 / J is at most 1 / J_0, so that the stress stays finite.
        """
        rows = to_host(self.solid.hessian_at(q, False).state)
        places = self.solid.places
        state = rows.reshape(-1, STATE, LANES).transpose(0, 2, 1).reshape(-1, STATE)[places]
        f = state[:, :9].reshape(-1, 3, 3)
        slope = state[:, 9] * self.solid.blocks.h4**2 / self.cells.volume
        share = self.cells.shear / np.maximum(np.linalg.det(f), ONSET)
        stress: Rows = (share[:, None, None] * (f @ f.transpose(0, 2, 1))).reshape(-1, 9)[:, UPPER]
        stress[:, :3] += slope[:, None]
        energies = cell_changes(
            self.solid.blocks, LANES * len(self.solid.blocks.nodes), q, self.rest
        )
        energies = to_host(energies)[places] / self.cells.volume
        own = slice(self.cells_owned)
        of_nodes = _fields(self.around @ stress, self.around @ energies)
        return of_nodes | {
            f"cell_{name}": rows for name, rows in _fields(stress[own], energies[own]).items()
        }


def _fields(stress: Rows, energy: Floats) -> dict[str, Any]:
    """Return stresses (k, 6) [Pa], their invariants (k,) [Pa] and energies (k,) [J/m^3] by name."""
    pressure = -stress[:, :3].mean(axis=1)
    deviator = np.concatenate(
        [stress[:, :3] + pressure[:, None], np.sqrt(2) * stress[:, 3:]], axis=1
    )
    von_mises = np.sqrt(1.5) * np.linalg.norm(deviator, axis=1)
    return {"stress": stress, "von_mises": von_mises, "pressure": pressure, "strain_energy": energy}
