"""Elastic energy of a lattice for every material law: the interface between solver and material."""

from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows, on_host
from msmpetsc.elasticity.pressure import Pressures
from msmpetsc.elasticity.solid import NeoHookean
from msmpetsc.elasticity.springs import Product, SpringGather, SpringScatter
from msmpetsc.elasticity.viscosity import Viscosity
from msmpetsc.lattice.lattice import Lattice


class Elasticity:
    """Elastic energy E of this rank's part of a lattice, its gradient and its Hessian.

    The law is a neo-Hookean solid (elasticity.solid) or linear springs (elasticity.springs).
    ``springs``, ``solid``, ``viscosity`` and ``pressures`` are None if E has no such part. If the
    solid is viscous, E includes the dissipation potential D of the step that ``viscosity`` began
    last. E also includes the potential of pressures, which are 0 until a step sets their values.

    Positions are local (l, 3) [m]. Energies are sums over the springs or cells that this rank owns.
    Gradients and products are complete in the owned rows.
    """

    def __init__(self, lattice: Lattice, solid: NeoHookean | None = None):
        """Make the energy, or share the ``solid`` of another lattice with the same cells."""
        self.owned, self.rest = lattice.owned, lattice.nodes
        self.springs: SpringScatter | SpringGather | None = None
        self.solid = solid or (NeoHookean.of_lattice(lattice) if lattice.solid else None)
        self.viscosity: Viscosity | None = None
        if self.solid and lattice.viscous:
            self.viscosity = Viscosity(self.solid, lattice.viscous, lattice.owned, lattice.nodes)
        if self.solid is None:
            self.springs = (SpringScatter if on_host(lattice.nodes) else SpringGather).of_lattice(
                lattice
            )
        self.pressures = Pressures(lattice.pressed) if lattice.pressed else None
        laws = self.solid, self.springs, self.viscosity, self.pressures
        self.parts = [part for part in laws if part]

    def energy(self, q: Positions) -> float:
        """Return this rank's part of E [J]: the change from the rest state, plus D."""
        viscous = self.viscosity.energy(q) if self.viscosity else 0.0
        laws = self.solid, self.springs, self.pressures
        return viscous + sum(law.change(q, self.rest) for law in laws if law)

    def change(self, q: Positions, base: Positions) -> float:
        """Return this rank's part of E(q) - E(base) [J]."""
        return sum(part.change(q, base) for part in self.parts)

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add grad E [N] to ``gradient`` (l, 3)."""
        for part in self.parts:
            part.add_gradient(q, gradient)

    @property
    def corners(self) -> Indices:
        """Corner nodes (c, 8) of this rank's cells, in the solid's order; (0, 8) for springs."""
        return self.solid.corners if self.solid else np.empty((0, 8), np.int64)

    @property
    def bound(self) -> float | None:
        """Factor c [-]: c D bounds the projected Hessian, with D of ``add_bound``.

        It is None for a solid, for which c must be measured.
        """
        return None if self.solid else 2.0

    def concavity(self, q: Positions) -> Floats:
        """Return a diagonal C >= 0 (owned,) [N/m]: Hessian + C is positive semidefinite at q.

        C is 0 at a node without compressed springs, strained cells of a solid, or pressure.
        """
        concavity = np.zeros(len(q), like=q)
        law = self.solid or self.springs
        assert law is not None
        law.add_concavity(q, concavity)
        if self.pressures:
            self.pressures.add_concavity(q, concavity)
        return concavity[: self.owned]

    def hessian_at(
        self, q: Positions, projected: bool = False, dtype: type = np.float64
    ) -> "Hessian":
        """Return the Hessian of E at q (l, 3) [m].

        projected : leave out negative parts, so that the Hessian is positive semidefinite
        dtype     : type of the stored numbers
        """
        return Hessian([part.hessian_at(q, projected, dtype) for part in self.parts])

    def add_bound(self, q: Positions, blocks: Rows) -> None:
        """Add a block diagonal D to the owned rows of ``blocks`` (l, 9) [N/m].

        The projected Hessian at q is at most ``bound`` times D. A semidefinite form of n nodes is
        at most n times its block diagonal, with n = 2 for a spring. For a cell n = 8, but the
        factor is usually less.
        """
        for part in self.parts:
            part.add_bound(q, blocks)


@dataclass(frozen=True)
class Hessian:
    """Hessian of E at given positions, as the sum of its parts."""

    parts: list[Product]

    def add_product(self, v: Array, product: Array) -> None:
        """Add Hessian v [N] to ``product`` (l, 3)."""
        for add in self.parts:
            add(v, product)
