"""Coulomb's friction between two parts of one surface in one step, lagged: of the contacts where the step starts, with
their push there. It is a potential of the slip S - S_n, of the same law as an obstacle's (contact.obstacles.friction).
"""

from typing import TYPE_CHECKING

import numpy as np

from msmpetsc.backend.arrays import Positions, Rows
from msmpetsc.contact.surface.barrier import Barrier, ContactSets

if TYPE_CHECKING:
    import ipctk
    from scipy.sparse import csc_matrix


class SurfaceFriction:
    """Friction, on the rank that has the points.

    contacts : where the step starts, the points at ``start`` (p, 3) [m]
    stick    : slip [m] below which it fades to nothing
    """

    def __init__(self, barrier: Barrier, contacts: ContactSets, start: Positions, stick: float):
        library, self.mesh, self.start = barrier.ipctk, barrier.mesh, start
        self.contacts: list[ipctk.TangentialCollisions] = []
        for potential, pairs in barrier.pushing(contacts):
            self.contacts.append(library.TangentialCollisions())
            self.contacts[-1].build(
                self.mesh, np.asfortranarray(start), pairs, potential, barrier.law.friction
            )  # its normals and pushes stay
        self.potential = library.FrictionPotential(stick)

    def energy(self, points: Positions) -> float:
        """Return the potential [J] of points that came to S (p, 3) [m]."""
        slip = self._slip(points)
        return sum(self.potential(pairs, self.mesh, slip) for pairs in self.contacts)

    def gradient(self, points: Positions) -> Rows:
        """Return its gradient (p, 3) [N]."""
        slip, gradient = self._slip(points), np.zeros(points.size)
        for pairs in self.contacts:
            gradient += self.potential.gradient(pairs, self.mesh, slip)
        return gradient.reshape(-1, 3)

    def hessian(self, points: Positions) -> "list[csc_matrix]":
        """Return the terms (3p, 3p) [N/m] of its Hessian, which is positive semidefinite."""
        slip = self._slip(points)
        return [self.potential.hessian(pairs, self.mesh, slip) for pairs in self.contacts]

    def _slip(self, points: Positions) -> Rows:
        return np.asfortranarray(points - self.start)
