"""Coulomb friction in implicit steps, for nodes on obstacles and for surfaces in contact.

The normal force N is known before the step is solved. Then friction has the convex potential
mu N f(|u|) of the slip u (Li et al. 2020, Incremental Potential Contact, Eq. 12 to 15), with

    f(u) = u^2 / e - u^3 / (3 e^2) + e / 3  for u < e,    f(u) = u  for u >= e.

A contact sticks if its slip is shorter than e, and slides otherwise. Li et al. start each step at
zero slip, so a sticking contact creeps. Here the elastic part of the slip, at most e long,
continues in the next step, and a sticking contact rests. Source: Simo and Laursen 1992, An
augmented Lagrangian treatment of contact problems involving friction.

A sliding contact has no curvature along its slip, so a step with the true Hessian may reverse the
slip and go much too far. Newton's method therefore treats the friction force p, in units of mu N,
as a dual unknown. It linearises p = f'(|u|) u / |u| in p and u. If p is the force of the present
slip, the Hessian is the true Hessian; otherwise it is stiffer. Source: Chan, Golub and Mulet 1999,
A nonlinear primal-dual method for total variation-based image restoration, SIAM J. Sci. Comput. 20.
"""

from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Floats, Positions, Rows

# default slip speed e / (time step) below which a contact sticks [longest side of the
# smallest body / s]
STICK = 1e-2
# smallest f' to divide by [-]; the square of the quotient does not overflow
TINY_SLOPE = 1e-100


@dataclass(frozen=True)
class Friction:
    """Friction in a step: the law for nodes on an obstacle and for surfaces in contact.

    limit : (a,) mu N [N]
    stick : e [m]
    begin : (a or 1, 3) elastic slips at the beginning of the step [m]
    """

    limit: Floats
    stick: float
    begin: Rows

    def along(self, moved: Rows) -> Rows:
        """Return the slips (a, 3) [m] that displacements ``moved`` (n, 3) [m] cause."""
        raise NotImplementedError

    def slip(self, q: Positions) -> tuple[Rows, Floats]:
        """Return the slip u (a, 3) [m] at positions q (n, 3) and its length (a,) [m]."""
        raise NotImplementedError

    def change(self, q: Positions, base: Positions, moved: Rows | None = None) -> float:
        """Return the energy change [J] from base to q: the sum of mu N (f(u) - f(u_0)).

        The change of |u| is computed from the displacement, so a small change keeps its digits.

        moved : (n, 3) q - base [m], if the caller knows it with more digits
        """
        u, length = self.slip(q)
        u_0, length_0 = self.slip(base)
        e = self.stick
        moved = self.along(q - base if moved is None else moved)
        elongation = (moved * (u + u_0)).sum(axis=1) / np.maximum(
            length + length_0, np.finfo(float).tiny
        )
        # |u| - |u_0| is the sum of its parts below and above e.
        low, low_0 = np.minimum(length, e), np.minimum(length_0, e)
        above = np.maximum(length, e) - np.maximum(length_0, e)
        below = np.where(np.maximum(length, length_0) < e, elongation, low - low_0)
        above = np.where(np.minimum(length, length_0) >= e, elongation, above)
        mean_slope = (low + low_0) / e - (low**2 + low * low_0 + low_0**2) / (3 * e**2)
        return float(self.limit @ (below * mean_slope + above))

    def slope(self, u: Floats) -> Floats:
        """Return f'(u) / u (a,) [1/m] for slips of length u (a,) [m]."""
        return np.where(
            u < self.stick, (2 - u / self.stick) / self.stick, 1 / np.maximum(u, self.stick)
        )

    def elastic_slip(self, q: Positions, stick: float) -> Rows:
        """Return the elastic slips (a, 3) [m] at positions q (n, 3), where the next step starts.

        stick : e of the next step [m]
        """
        u, length = self.slip(q)
        return u * (stick / np.maximum(length, self.stick))[:, None]

    def released(self, q: Positions) -> float:
        """Return the energy [J] of the elastic slips at the step's beginning minus that at q."""
        ends = np.linalg.norm(self.begin, axis=1), np.minimum(self.slip(q)[1], self.stick)
        begin, end = (length**2 / self.stick - length**3 / (3 * self.stick**2) for length in ends)
        return float(self.limit @ (begin - end))

    def force(self, q: Positions) -> Rows:
        """Return the gradient mu N f'(|u|) u / |u| (a, 3) [N] with respect to the slip."""
        u, length = self.slip(q)
        return (self.limit * self.slope(length))[:, None] * u

    def no_duals(self) -> Rows:
        """Return zero duals (a, 3), for which ``curvature`` is the secant mu N (f'/u) (I - n n^T).

        f is concave in u^2, so the parabola with this curvature bounds the potential from above.
        """
        return np.zeros((len(self.limit), 3), like=self.limit)

    def duals_after(self, q: Positions, base: Positions, duals: Rows | None) -> Rows:
        """Return the duals (a, 3) after the full step from base to q, at most 1 in length.

        duals : (a, 3) at base; None for the forces of the slips
        """
        u, _ = self.slip(q)
        u_0, length_0 = self.slip(base)
        slope = self.slope(length_0)
        tiny = np.finfo(float).tiny
        before = slope[:, None] * u_0 if duals is None else duals
        along = (u_0 * (u - u_0)).sum(axis=1) / np.maximum(length_0, tiny)
        factor = self._bend(length_0) / np.maximum(slope * length_0, tiny) * along
        return shortened(slope[:, None] * u + factor[:, None] * before)

    def curvature(self, q: Positions, plane: Rows, duals: Rows | None) -> Rows:
        """Return mu N (f'/u (I - n n^T) + (f'' - f'/u) (w d^T + d w^T) / 2) (a, 3, 3) [N/m].

        d is the slip's direction. w is p / f', scaled down to length 1 if longer, so that each
        block is positive semidefinite.

        plane : (a or 1, 3, 3) I - n n^T
        duals : (a, 3) p; None for the forces of the slips: then w = d, and the Hessian is true
        """
        u, length = self.slip(q)
        slope = self.slope(length)
        d = u / np.maximum(length, np.finfo(float).tiny)[:, None]
        w = (
            d
            if duals is None
            else shortened(duals / np.maximum(slope * length, TINY_SLOPE)[:, None])
        )
        mixed = 0.5 * (w[:, :, None] * d[:, None, :] + d[:, :, None] * w[:, None, :])
        blocks: Rows = slope[:, None, None] * plane + self._bend(length)[:, None, None] * mixed
        return self.limit[:, None, None] * blocks

    def _bend(self, u: Floats) -> Floats:
        """Return f'' - f' / u <= 0 (a,) [1/m]: curvature along the slip minus curvature across."""
        difference: Floats = np.where(u < self.stick, 2 * (1 - u / self.stick) / self.stick, 0.0)
        difference -= self.slope(u)
        return difference


def squares(vectors: Rows) -> Rows:
    """Return v v^T (a, 3, 3) of vectors v (a, 3)."""
    return vectors[:, :, None] * vectors[:, None, :]


def shortened(vectors: Rows) -> Rows:
    """Return vectors (a, 3), scaled to length 1 if they are longer."""
    short: Rows = vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1.0)[:, None]
    return short


def smallest(bounds: Rows) -> float:
    """Return the longest side [m] of the smallest body, from bounds (b, 2, 3) [m]."""
    return float((bounds[:, 1] - bounds[:, 0]).max(axis=1).min())
