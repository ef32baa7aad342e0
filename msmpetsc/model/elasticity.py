"""The elastic energy of a lattice, whatever its law: what the solver sees of a material."""

import numpy as np
from mpi4py import MPI

from msmpetsc.model.energy import (
    add_elastic_gradient,
    add_elastic_product,
    elastic_change,
    elastic_energy,
    elastic_hessian,
)
from msmpetsc.model.inversion import (
    add_resistance_gradient,
    add_resistance_hessian,
    least_volumes,
    resistance_change,
    resistance_energy,
)
from msmpetsc.model.lattice import Lattice

ONSET = 0.5  # J_0: a cell's corner resists when it is pressed below this share of its volume at rest
RESISTANCE = 1.0  # K of a corner, of its material's k1 h^2: an eighth left a lung pressed to 30% torn


class Elasticity:
    """E of this rank's share of a lattice, its gradient and its Hessian: Hooke's springs (model.energy), or, where
    the law stiffens, stiffening ones and cells that resist being turned inside out (model.inversion).

    Positions are local (l, 3) [m]. Energies are of what this rank owns; gradients and products are right at the
    owned nodes.
    """

    def __init__(self, comm: MPI.Comm, lattice: Lattice):
        self.all = lattice.springs, lattice.rest_length, lattice.stiffness, lattice.stiffening
        self.own = *(array[: lattice.springs_owned] for array in self.all[:3]), lattice.stiffening
        self.cells = self.own_cells = None
        if lattice.stiffening > 0:
            volume, h = ONSET * lattice.cell_size**3, lattice.cell_size
            self.cells = lattice.local_cells, RESISTANCE * lattice.cell_stiffness * h**2, volume
            self.own_cells = *(array[: lattice.cells_owned] for array in self.cells[:2]), volume

    def energy(self, q: np.ndarray) -> float:
        """[J]"""
        return elastic_energy(q, *self.own) + (resistance_energy(q, *self.own_cells) if self.cells else 0.0)

    def change(self, q: np.ndarray, base: np.ndarray) -> float:
        """E(q) - E(base) [J]."""
        change = elastic_change(q, base, *self.own)
        if self.cells:
            change += resistance_change(q, base, *self.own_cells)
        return change

    def add_gradient(self, q: np.ndarray, gradient: np.ndarray) -> None:
        """Add grad E [N] to ``gradient`` (l, 3)."""
        add_elastic_gradient(q, *self.all, gradient)
        if self.cells:
            add_resistance_gradient(q, *self.cells, gradient)

    def resisting(self, q: np.ndarray) -> np.ndarray:
        """The cells (r,) of all that resist at q: few, so that products with the Hessian need not look at the others."""
        if not self.cells:
            return np.empty(0, np.int64)
        cells, _, volume = self.cells
        return np.flatnonzero(least_volumes(q, cells) < volume)

    def hessian_at(self, q: np.ndarray, projected: bool = False) -> "Hessian":
        """The Hessian of E at q.

        projected : without its negative parts, as of compressed springs
        """
        return Hessian(self, q, self.resisting(q), projected)


class Hessian:
    """The Hessian of E at one q, ready for many products; ``resisting``: which cells do there."""

    def __init__(self, elasticity: Elasticity, q: np.ndarray, resisting: np.ndarray, projected: bool):
        self.springs, self.blocks = elasticity.all[0], elastic_hessian(q, *elasticity.all, projected)
        self.resisting, self.projected = len(resisting) > 0, projected
        if self.resisting:
            cells, resistance, volume = elasticity.cells
            self.q, self.cells = q.copy(), (cells[resisting], resistance[resisting], volume)

    def add_product(self, v: np.ndarray, product: np.ndarray) -> None:
        """Add Hessian v [N] to ``product`` (l, 3)."""
        add_elastic_product(self.springs, self.blocks, v, product)
        if self.resisting:
            add_resistance_hessian(self.q, *self.cells, self.projected, v, product)
