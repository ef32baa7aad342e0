"""The elastic energy of a lattice, whatever its law: the interface of the solver to a material."""

from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows, on_host
from msmpetsc.elasticity.solid import NeoHookean
from msmpetsc.elasticity.springs import Product, SpringGather, SpringScatter
from msmpetsc.elasticity.viscosity import Viscosity
from msmpetsc.lattice.lattice import Lattice


class Elasticity:
    """E of this rank's part of a lattice, its gradient and its Hessian.

    It is that of a neo-Hookean solid (elasticity.solid), or of Hooke's springs (elasticity.springs).

    Positions are local (l, 3) [m]. Energies are of what this rank owns; gradients and products are right at the owned
    nodes. ``springs``, ``solid`` and ``viscosity`` are None where the law has none. Where there is viscosity
    E has its D, of the step that it was given last.
    """

    def __init__(self, lattice: Lattice):
        self.owned, self.rest = lattice.owned, lattice.nodes
        self.springs: SpringScatter | SpringGather | None = None
        self.solid = None if lattice.solid is None else NeoHookean.of_lattice(lattice)
        self.viscosity: Viscosity | None = None
        if self.solid and lattice.viscous:
            self.viscosity = Viscosity(self.solid, lattice.viscous, lattice.owned, lattice.nodes)
        if self.solid is None:
            self.springs = (SpringScatter if on_host(lattice.nodes) else SpringGather).of_lattice(
                lattice
            )
        self.parts = [part for part in (self.solid, self.springs, self.viscosity) if part]

    def energy(self, q: Positions) -> float:
        """Return E [J] of what this rank owns: laws' changes from rest, where E is 0, and D."""
        viscous = self.viscosity.energy(q) if self.viscosity else 0.0
        return viscous + sum(law.change(q, self.rest) for law in (self.solid, self.springs) if law)

    def change(self, q: Positions, base: Positions) -> float:
        """Return E(q) - E(base) [J] of what this rank owns."""
        return sum(part.change(q, base) for part in self.parts)

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add grad E [N] to ``gradient`` (l, 3)."""
        for part in self.parts:
            part.add_gradient(q, gradient)

    @property
    def corners(self) -> Indices:
        """Corner nodes (c, 8) of the cells of the law that this rank owns, in its order; (0, 8) of springs alone."""
        return self.solid.corners if self.solid else np.empty((0, 8), np.int64)

    @property
    def bound(self) -> float | None:
        """By how much the projected Hessian may exceed D of ``add_bound``; None where that is to be measured."""
        return None if self.solid else 2.0

    def concavity(self, q: Positions) -> Floats:
        """Return the diagonal (owned,) [N/m] of a matrix: the Hessian is no less than minus that.

        It is 0 at a node without compressed springs, and where no cell around it is strained.
        """
        concavity = np.zeros(len(q), like=q)
        law = self.solid or self.springs
        assert law is not None
        law.add_concavity(q, concavity)
        return concavity[: self.owned]

    def hessian_at(
        self, q: Positions, projected: bool = False, dtype: type = np.float64
    ) -> "Hessian":
        """Return the Hessian of E at q (l, 3) [m].

        projected : without its negative parts, as of compressed springs
        dtype     : of what is stored of it
        """
        return Hessian([part.hessian_at(q, projected, dtype) for part in self.parts])

    def add_bound(self, q: Positions, blocks: Rows) -> None:
        """Add a block diagonal D, such that the projected Hessian at q is no more than ``bound`` D, to the
        owned rows of ``blocks`` (l, 9) [N/m].

        A sum over n nodes is no more than n times its diagonal: two of a spring, whose D is its diagonal, and eight of
        a cell, where it is seldom so much.
        """
        for part in self.parts:
            part.add_bound(q, blocks)


@dataclass(frozen=True)
class Hessian:
    """The Hessian of E at one q, ready for many products."""

    parts: list[Product]

    def add_product(self, v: Array, product: Array) -> None:
        """Add Hessian v [N] to ``product`` (l, 3)."""
        for add in self.parts:
            add(v, product)
