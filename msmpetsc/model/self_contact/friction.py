"""Coulomb's friction between two parts of one surface in one step, lagged: of the contacts where the step starts, with
their push there. It is a potential of the slip S - S_n, of the same law as an obstacle's (model.contact.penalty)."""

from typing import TYPE_CHECKING

import numpy as np

from msmpetsc.model.self_contact.barrier import Barrier

if TYPE_CHECKING:
    import ipctk
    from scipy.sparse import csc_matrix


class SurfaceFriction:
    """Friction, on the rank that has the points.

    contacts : where the step starts, the points at ``start`` (p, 3) [m]
    stick    : slip [m] below which it fades to nothing
    """

    def __init__(self, barrier: Barrier, contacts: "ipctk.NormalCollisions", start: np.ndarray, stick: float):
        ipctk, self.mesh, self.start = barrier.ipctk, barrier.mesh, start
        self.contacts = ipctk.TangentialCollisions()
        self.contacts.build(
            self.mesh, np.asfortranarray(start), contacts, barrier.potential, barrier.law.friction
        )  # its normals and pushes stay
        self.potential = ipctk.FrictionPotential(stick)

    def energy(self, points: np.ndarray) -> float:
        """Return the potential [J] of points that came to S (p, 3) [m]."""
        return self.potential(self.contacts, self.mesh, self._slip(points))

    def gradient(self, points: np.ndarray) -> np.ndarray:
        """Return its gradient (p, 3) [N]."""
        return self.potential.gradient(self.contacts, self.mesh, self._slip(points)).reshape(-1, 3)

    def hessian(self, points: np.ndarray) -> "csc_matrix":
        """Return its Hessian (3p, 3p) [N/m], which is positive semidefinite."""
        return self.potential.hessian(self.contacts, self.mesh, self._slip(points))

    def _slip(self, points: np.ndarray) -> np.ndarray:
        return np.asfortranarray(points - self.start)
