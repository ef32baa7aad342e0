"""A narrow cantilever that buckles sideways under a dead load at its end.

Lattices are compared with quadratic hexahedra of the same law and with a Kirchhoff rod. Run as a
script it prints the figures of `scripts/results/solid.md`.
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np
import skfem
from few_cells import torsion_constant, torsion_error
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, root
from scipy.sparse import coo_array, csc_array
from scipy.spatial.transform import Rotation
from skfem.models.elasticity import lame_parameters
from small_strain import NU, SHEAR, E, box, factorise, hessian

from msmpetsc.elasticity.energy import Elasticity

# sides along x, y and z [m]
LENGTH, WIDTH, HEIGHT = 20.0, 0.5, 2.0
# E I sideways and downwards, G J [N m^2]
SIDE, DOWN = E * HEIGHT * WIDTH**3 / 12, E * WIDTH * HEIGHT**3 / 12
TWIST = SHEAR * torsion_constant(HEIGHT / WIDTH) * WIDTH**4
# Critical load [N] of a slender cantilever (Timoshenko and Gere 1961, 6.4), corrected
# as for a beam bent by couples
TEXTBOOK = 4.0126 * np.sqrt(SIDE * TWIST / (1 - SIDE / DOWN) / (1 - TWIST / DOWN)) / LENGTH**2
# sideways load over the load [-]
ASIDE = 1e-3
# by hexahedra, to 0.1%: critical load over TEXTBOOK [-], sideways displacement [m] of
# the end under 0.9 of TEXTBOOK
CRITICAL, SIDEWAYS = 1.072, 0.0784
# by hexahedra: length [m] at the clamp that does not twist, since the clamp holds the
# warping
HELD = 0.383
# change [m] that ends Newton's method; most iterations
SMALL, MOST = 1e-9, 30


class Beam(Protocol):
    """A discrete beam: nodes (n, 3) [m], and their shares (n,) of a load on the end."""

    nodes: np.ndarray
    share: np.ndarray

    def forces(self, u: np.ndarray) -> np.ndarray:
        """Return the gradient (n, 3) [N] of the energy at displacements (n, 3)."""

    def stiffness(self, u: np.ndarray) -> csc_array:
        """Return the Hessian (3n, 3n) [N/m] of the energy at displacements (n, 3)."""


class LatticeBeam:
    """The beam as a lattice with so many cells across its width."""

    def __init__(self, across: int):
        h = WIDTH / across
        sides = np.rint(np.array([LENGTH, WIDTH, HEIGHT]) / h).astype(int)
        self.lattice = box(sides, h, NU)
        self.nodes, self.elastic = self.lattice.nodes, Elasticity(self.lattice)
        self.share = self.lattice.mass * np.isclose(self.nodes[:, 0], LENGTH)
        self.share /= self.share.sum()

    def forces(self, u: np.ndarray) -> np.ndarray:
        gradient = np.zeros_like(u)
        self.elastic.add_gradient(self.nodes + u, gradient)
        return gradient

    def stiffness(self, u: np.ndarray) -> csc_array:
        return hessian(self.lattice, self.nodes + u)


class Hexahedra:
    """The beam of quadratic hexahedra, whose lengths [m] grow from ``first`` at the clamp to 1."""

    def __init__(self, across: int, high: int, first: float):
        x = [0.0, first]
        while x[-1] < LENGTH:
            x.append(x[-1] + min(1.3 * (x[-1] - x[-2]), 1.0))
        ends = np.linspace(0, WIDTH, across + 1), np.linspace(0, HEIGHT, high + 1)
        mesh = skfem.MeshHex.init_tensor(np.array(x) * LENGTH / x[-1], *ends)
        basis = skfem.Basis(mesh, skfem.ElementHex2(), intorder=5)
        self.nodes, self.corners = basis.doflocs.T, basis.element_dofs.T
        gradients = [basis.basis[k][0].grad for k in range(self.corners.shape[1])]
        # (element, point, node, axis)
        self.slopes = np.array(gradients).transpose(2, 3, 0, 1)
        self.volumes = basis.dx
        end = mesh.facets_satisfying(lambda x: np.isclose(x[0], LENGTH), boundaries_only=True)
        face = skfem.FacetBasis(mesh, basis.elem, facets=end, intorder=4)
        self.share = skfem.LinearForm(lambda v, _: v / (WIDTH * HEIGHT)).assemble(face)
        self.entries = (3 * self.corners[:, :, None] + np.arange(3)).reshape(len(self.corners), -1)
        self.lame, self.mu = lame_parameters(E, NU)

    def _deformation(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return F and its inverse, and J."""
        F = np.eye(3) + np.einsum("eai,eqaJ->eqiJ", u[self.corners], self.slopes, optimize=True)
        return F, np.linalg.inv(F), np.linalg.det(F)

    def forces(self, u: np.ndarray) -> np.ndarray:
        F, inverse, J = self._deformation(u)
        push = self.lame * (J - 1) * J - self.mu
        P = self.mu * F + push[..., None, None] * inverse.swapaxes(-1, -2)
        parts = np.einsum("eq,eqiJ,eqaJ->eai", self.volumes, P, self.slopes, optimize=True)
        return np.bincount(self.entries.ravel(), parts.ravel(), u.size).reshape(-1, 3)

    def stiffness(self, u: np.ndarray) -> csc_array:
        _, inverse, J = self._deformation(u)
        push, bulk = self.lame * (J - 1) * J - self.mu, self.lame * (2 * J - 1) * J
        tangent = self.mu * np.einsum("ik,JL->iJkL", np.eye(3), np.eye(3)) + (
            np.einsum("eq,eqJi,eqLk->eqiJkL", bulk, inverse, inverse)
            - np.einsum("eq,eqLi,eqJk->eqiJkL", push, inverse, inverse)
        )
        right = np.einsum(
            "eq,eqiJkL,eqbL->eqJibk", self.volumes, tangent, self.slopes, optimize=True
        )
        elements, points, nodes, _ = self.slopes.shape
        left = self.slopes.transpose(0, 2, 1, 3).reshape(elements, nodes, 3 * points)
        blocks = left @ right.reshape(elements, 3 * points, -1)
        rows, columns = np.broadcast_arrays(self.entries[:, :, None], self.entries[:, None])
        places = rows.ravel(), columns.ravel()
        return coo_array((blocks.ravel(), places), shape=(u.size, u.size)).tocsc()


def solver(beam: Beam, u: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function from forces (n, 3) to small displacements (n, 3) beside u."""
    free = np.repeat(~np.isclose(beam.nodes[:, 0], 0), 3)
    inverse = factorise(beam.stiffness(u)[free][:, free])

    def solve(f: np.ndarray) -> np.ndarray:
        change = np.zeros(f.size)
        change[free] = inverse(f.ravel()[free])
        return change.reshape(-1, 3)

    return solve


def loaded(beam: Beam, load: float, aside: float = 0.0, u: np.ndarray | None = None) -> np.ndarray:
    """Return the displacements (n, 3) under loads [N] down and sideways, by Newton from u."""
    f = beam.share[:, None] * [0, aside, -load]
    u = np.zeros_like(f) if u is None else u
    for _ in range(MOST):
        change = solver(beam, u)(f - beam.forces(u))
        u = u + change
        if np.abs(change).max() < SMALL:
            return u
    raise RuntimeError(f"no balance at {load} N after {MOST} iterations")


def sideways(beam: Beam, load: float) -> float:
    """Return the sideways displacement [m] of the end under a load [N] and ASIDE of it sideways."""
    u = None
    for part in (0.4, 0.8, 1.0):
        u = loaded(beam, part * load, ASIDE * part * load, u)
    return float(beam.share @ u[:, 1])


def critical(beam: Beam) -> float:
    """Return the load [N] at which a small sideways force meets no resistance.

    It is interpolated, because Newton's method is singular at the critical load itself.
    """
    u = loaded(beam, 0.5 * TEXTBOOK)
    sideways = beam.share[:, None] * [0, 1, 0]
    loads, resistances = TEXTBOOK * np.array([1.0, 1.05, 1.12, 1.15]), []
    for load in loads:
        u = loaded(beam, load, u=u)
        resistances.append(1 / np.vdot(sideways, solver(beam, u)(sideways)))
    return float(np.polyfit(resistances, loads, 3)[-1])


def shortening(beam: Beam) -> float:
    """Return the length [m] at the clamp that does not twist, as the clamp holds its warping."""
    arm = beam.nodes - [0, WIDTH / 2, HEIGHT / 2]
    u = solver(beam, np.zeros_like(arm))(beam.share[:, None] * np.cross([1, 0, 0], arm))
    turns = []
    for near in (0.3 * LENGTH, 0.7 * LENGTH):
        x = beam.nodes[np.abs(beam.nodes[:, 0] - near).argmin(), 0]
        at = np.isclose(beam.nodes[:, 0], x)
        turns.append((x, np.cross(arm, u)[at, 0].sum() / (arm[at, 1:] ** 2).sum()))
    (x, low), (y, high) = turns
    return x - low * (y - x) / (high - low)


# ---- a Kirchhoff rod


def clamp_of(
    tip: np.ndarray, load: float, aside: float, held: float, GJ: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation (3, 3) and position (3,) of a rod's clamp relative to its tip.

    tip  : rotation vector (3,) of the tip
    held : length [m] at the clamp that does not twist
    """
    force = np.array([0, aside, -load])
    compliance = 1 / np.array([GJ, DOWN, SIDE])

    def rates(_: float, state: np.ndarray, twists: bool) -> np.ndarray:
        at, R = state[:3], state[3:].reshape(3, 3)
        x, y, z = compliance * [twists, 1, 1] * (R.T @ np.cross(-at, force))
        curvature = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return -np.concatenate([R[:, 0], (R @ curvature).ravel()])

    state = np.concatenate([np.zeros(3), Rotation.from_rotvec(tip).as_matrix().ravel()])
    for span, twists in (((0, LENGTH - held), True), ((LENGTH - held, LENGTH), False)):
        if held or twists:
            path = solve_ivp(rates, span, state, args=(twists,), rtol=1e-10, atol=1e-12)
            state = path.y[:, -1]
    return state[3:].reshape(3, 3), state[:3]


def rod_critical(held: float = 0.0, GJ: float = TWIST) -> float:
    """Return the load [N] at which an inextensible rod, bent by this load, has a second state."""

    def determinant(load: float) -> float:
        def clamp(*tip: float) -> np.ndarray:
            return clamp_of(np.array(tip), load, 0.0, held, GJ)[0]

        down = brentq(lambda angle: clamp(0, angle, 0)[0, 2], 0, 1.2)
        small = 1e-5
        changes = [clamp(*small * axis + [0, down, 0]) for axis in np.eye(3)[[0, 2]]]
        return np.linalg.det([[R[1, 0], R[2, 1]] for R in changes]) / small**2

    return brentq(determinant, 0.9 * TEXTBOOK, 1.2 * TEXTBOOK)


def rod_sideways(load: float, held: float = 0.0, GJ: float = TWIST) -> float:
    """Return how far a rod's end goes sideways [m] under a load [N] and ASIDE of it."""

    def turned(tip: np.ndarray) -> list[float]:
        R = clamp_of(tip, load, ASIDE * load, held, GJ)[0]
        return [R[1, 0], R[2, 0], R[2, 1]]

    tip = root(turned, [0, 0.1, 0], tol=1e-12).x
    return -clamp_of(tip, load, ASIDE * load, held, GJ)[1][1]


if __name__ == "__main__":
    load = 0.9 * TEXTBOOK
    for meshes in ((2, 6, 0.125), (2, 8, 0.06), (3, 10, 0.06)):
        beam = Hexahedra(*meshes)
        print(
            f"hexahedra {meshes}: critical {critical(beam) / TEXTBOOK:.4f} of the textbook's, "
            f"sideways {sideways(beam, load):.5f} m, no twist over {shortening(beam):.3f} m",
            flush=True,
        )
    for length in (0.0, HELD):
        print(
            f"rod, no twist over {length:.3f} m: critical {rod_critical(length) / TEXTBOOK:.4f}, "
            f"sideways {rod_sideways(load, length):.5f} m"
        )
    for across in (2, 4):
        beam, error = LatticeBeam(across), torsion_error(across, NU, 4)
        GJ = TWIST * (1 + error)
        print(
            f"{across} cells: G J {error:+.2%}, "
            f"critical {critical(beam) / TEXTBOOK / CRITICAL - 1:+.2%}, by the rod "
            f"{rod_critical(HELD, GJ) / rod_critical(HELD) - 1:+.2%}; "
            f"sideways {sideways(beam, load) / SIDEWAYS - 1:+.2%}, by the rod "
            f"{rod_sideways(load, HELD, GJ) / rod_sideways(load, HELD) - 1:+.2%}; "
            f"0.9 of the critical load: {sideways(beam, 0.9 * CRITICAL * TEXTBOOK):.5f} m",
            flush=True,
        )
