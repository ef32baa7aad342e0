"""The elastic energy of a lattice, whatever its law: what the solver sees of a material."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import on_host
from msmpetsc.model.cell_gather import CellsAround
from msmpetsc.model.inversion import (
    add_resistance_gradient,
    add_resistance_hessian,
    least_volumes,
    resistance_change,
    resistance_energy,
)
from msmpetsc.model.lattice import Lattice
from msmpetsc.model.spring_gather import Neighbours
from msmpetsc.model.springs import (
    add_elastic_gradient,
    add_elastic_product,
    add_spring_concavity,
    elastic_change,
    elastic_energy,
    elastic_hessian,
)

ONSET = 0.5  # J_0: a cell's corner resists when it is pressed below this share of its volume at rest
RESISTANCE = 1.0  # K of a corner, of its material's k1 h^2: an eighth left a lung pressed to 30% torn

Product = Callable[[np.ndarray, np.ndarray], None]  # adds (a Hessian) v [N] to the second argument


class Elasticity:
    """E of this rank's share of a lattice, its gradient and its Hessian: Hooke's springs (model.springs), or, where
    the law stiffens, stiffening ones and cells that resist being turned inside out (model.inversion).

    Positions are local (l, 3) [m]. Energies are of what this rank owns; gradients and products are right at the
    owned nodes. ``cells`` is None where they do not resist.
    """

    def __init__(self, comm: MPI.Comm, lattice: Lattice):
        self.owned = lattice.owned
        self.springs, self.cells = (Springs if on_host(lattice.nodes) else Neighbours).of(lattice), None
        if lattice.stiffening > 0:
            volume, resistance = lattice.cell_size**3, lattice.cell_stiffness * lattice.cell_size**2
            kind = Cells if on_host(lattice.nodes) else CellsAround
            self.cells = kind.of(lattice, RESISTANCE * resistance, ONSET * volume)
        self.parts = [part for part in (self.springs, self.cells) if part]

    def energy(self, q: np.ndarray) -> float:
        """[J]"""
        return sum(part.energy(q) for part in self.parts)

    def change(self, q: np.ndarray, base: np.ndarray) -> float:
        """E(q) - E(base) [J]."""
        return sum(part.change(q, base) for part in self.parts)

    def add_gradient(self, q: np.ndarray, gradient: np.ndarray) -> None:
        """Add grad E [N] to ``gradient`` (l, 3)."""
        for part in self.parts:
            part.add_gradient(q, gradient)

    def concavity(self, q: np.ndarray) -> np.ndarray:
        """(owned,) [N/m]: the springs' Hessian is no less than minus the diagonal matrix of it, 0 where none is compressed."""
        concavity = np.zeros(len(q), like=q)
        self.springs.add_concavity(q, concavity)
        return concavity[: self.owned]

    def resists(self, q: np.ndarray) -> bool:
        """Whether a cell of this rank resists at q, whose Hessian then may have negative parts."""
        if self.cells is None or not len(self.cells.cells):
            return False
        return bool(least_volumes(q, self.cells.cells).min() < self.cells.volume)

    def hessian_at(self, q: np.ndarray, projected: bool = False) -> "Hessian":
        """The Hessian of E at q.

        projected : without its negative parts, as of compressed springs
        """
        return Hessian([part.hessian_at(q, projected) for part in self.parts])


@dataclass(frozen=True)
class Hessian:
    """The Hessian of E at one q, ready for many products."""

    parts: list[Product]

    def add_product(self, v: np.ndarray, product: np.ndarray) -> None:
        """Add Hessian v [N] to ``product`` (l, 3)."""
        for add in self.parts:
            add(v, product)


class Springs:
    """As a CPU takes them: one after another, those that this rank owns first."""

    def __init__(self, *all_of_them: np.ndarray | float, owned: int):
        self.all = all_of_them
        self.own = *(array[:owned] for array in self.all[:3]), self.all[3]

    @classmethod
    def of(cls, lattice: Lattice) -> "Springs":
        return cls(
            lattice.springs, lattice.rest_length, lattice.stiffness, lattice.stiffening, owned=lattice.springs_owned
        )

    def energy(self, q: np.ndarray) -> float:
        return elastic_energy(q, *self.own)

    def change(self, q: np.ndarray, base: np.ndarray) -> float:
        return elastic_change(q, base, *self.own)

    def add_gradient(self, q: np.ndarray, gradient: np.ndarray) -> None:
        add_elastic_gradient(q, *self.all, gradient)

    def add_concavity(self, q: np.ndarray, concavity: np.ndarray) -> None:
        add_spring_concavity(q, *self.all, concavity)

    def hessian_at(self, q: np.ndarray, projected: bool) -> Product:
        return partial(add_elastic_product, self.all[0], elastic_hessian(q, *self.all, projected))


class Cells:
    """As a CPU takes them: one after another, those that this rank owns first.

    all : (c, 8) local corner nodes, K (c,) [J], J_0 h^3 [m^3]
    """

    def __init__(self, cells: np.ndarray, resistance: np.ndarray, volume: float, owned: int):
        self.cells, self.volume = cells, volume
        self.all = cells, resistance, volume
        self.own = cells[:owned], resistance[:owned], volume

    @classmethod
    def of(cls, lattice: Lattice, resistance: np.ndarray, volume: float) -> "Cells":
        return cls(lattice.local_cells, resistance, volume, lattice.cells_owned)

    def energy(self, q: np.ndarray) -> float:
        return resistance_energy(q, *self.own)

    def change(self, q: np.ndarray, base: np.ndarray) -> float:
        return resistance_change(q, base, *self.own)

    def add_gradient(self, q: np.ndarray, gradient: np.ndarray) -> None:
        add_resistance_gradient(q, *self.all, gradient)

    def resisting(self, q: np.ndarray) -> np.ndarray:
        """Which cells (r,) resist at q: few, so that products with the Hessian need not look at the others."""
        cells, _, volume = self.all
        return np.flatnonzero(least_volumes(q, cells) < volume)

    def hessian_at(self, q: np.ndarray, projected: bool) -> Product:
        cells, resistance, volume = self.all
        few = self.resisting(q)
        return partial(add_resistance_hessian, q.copy(), cells[few], resistance[few], volume, projected)
