"""Bending and twist of few cells at small strain, against theory and finite elements.

A problem solves K u = f with the Hessian K at rest. Errors are those of stiffness in torsion, and
of deflection elsewhere.
"""

import numpy as np
import skfem
import trimesh
from scipy.sparse import eye_array
from skfem.models.elasticity import lame_parameters, linear_elasticity
from small_strain import E, box, factorise, hessian, lattice_of

from msmpetsc.lattice.lattice import Lattice

POISSON = (0.0, 0.25, 0.45, 0.499)
# displacements and forces (n, 3)
Fields = tuple[np.ndarray, np.ndarray]
# length of a cantilever of thickness 1 m [m]
LENGTH = 10


def shares(lattice: Lattice, *axes: int) -> np.ndarray:
    """Return the weights (n,) of nodes for integrals over some axes of a box of cells."""
    x = lattice.nodes
    ends = np.isclose(x, x.min(axis=0)) | np.isclose(x, x.max(axis=0))
    return np.where(ends[:, axes], 0.5, 1.0).prod(axis=1)


def solve(lattice: Lattice, fixed: np.ndarray, u: np.ndarray, f: np.ndarray) -> Fields:
    """Return u (n, 3) [m] under forces f (n, 3) [N] and the forces K u (n, 3) [N].

    fixed : (n, 3) mask of the prescribed entries of u
    """
    K, free = hessian(lattice), ~fixed.ravel()
    u = np.where(fixed, u, 0.0).ravel()
    u[free] = factorise(K[free][:, free])((f.ravel() - K @ u)[free])
    return u.reshape(-1, 3), (K @ u).reshape(-1, 3)


def clamped(lattice: Lattice, force: np.ndarray) -> float:
    """Return a cantilever's deflection under a unit force; its low end is clamped."""
    x = lattice.nodes - lattice.nodes.min(axis=0)
    end, weight = np.isclose(x[:, 0], x[:, 0].max()), shares(lattice, 1, 2)
    f = np.where(end, weight / weight[end].sum(), 0.0)[:, None] * force
    fixed = np.repeat(np.isclose(x[:, 0], 0)[:, None], 3, axis=1)
    return float((f * solve(lattice, fixed, np.zeros_like(f), f)[0]).sum())


# ---- torsion


def torsion_constant(width: float) -> float:
    """Return the torsion constant [m^4] of a rectangle 1 m thick (Timoshenko and Goodier 1951)."""
    n = np.arange(1, 100, 2)
    return (
        width / 3 * (1 - 192 / (np.pi**5 * width) * (np.tanh(n * np.pi * width / 2) / n**5).sum())
    )


def torsion_error(across: int, poisson: float, width: int = 1) -> float:
    """Return the error of the torsional stiffness of a bar 1 m thick, from bars of two lengths."""
    compliance = []
    for length in (3 * width, 6 * width):
        lattice = box((length * across, width * across, across), 1 / across, poisson)
        x = lattice.nodes
        left, right = np.isclose(x[:, 0], 0), np.isclose(x[:, 0], length)
        arm = x - [length, width / 2, 0.5]
        u = np.where(right[:, None], np.cross([1, 0, 0], arm), 0.0)
        fixed = np.repeat((left | right)[:, None], 3, axis=1)
        forces = solve(lattice, fixed, u, np.zeros_like(x))[1]
        compliance.append(1 / np.cross(arm, forces)[right].sum(axis=0)[0])
    exact = torsion_constant(width) * E / (2 * (1 + poisson))
    return 3 * width / (compliance[1] - compliance[0]) / exact - 1


# ---- plates


def plate_error(through: int, poisson: float, clamp: bool, side: int = 20) -> float:
    """Return the error of the deflection at the middle of a square plate under a uniform load.

    The plate has a thickness of 1 m. The reference is Mindlin's plate if it is simply supported.
    Otherwise it is Timoshenko and Woinowsky-Krieger (1959) with the shear of Mindlin's plate.
    """
    half = side // 2
    lattice = box((half * through, half * through, through), 1 / through, poisson)
    x = lattice.nodes
    low, high = np.isclose(x, 0), np.isclose(x, half)
    fixed = np.zeros(x.shape, bool)
    edge = low[:, 0] | low[:, 1]
    fixed[:, 2] = edge
    # symmetry, and a simple support that also holds the edge along itself
    fixed[high[:, 0], 0] = fixed[high[:, 1], 1] = True
    fixed[low[:, 0], 1] = fixed[low[:, 1], 0] = True
    if clamp:
        fixed[edge] = True
    weight = shares(lattice, 0, 1, 2)
    f = np.zeros_like(x)
    f[:, 2] = weight / weight.sum() * half**2
    w = solve(lattice, fixed, np.zeros_like(x), f)[0][high[:, 0] & high[:, 1], 2].mean()
    shear = 0.0736713 * side**2 / (5 / 6 * E / (2 * (1 + poisson)))
    rigidity = E / 12 / (1 - poisson**2)
    return float(w / ((0.00126532 if clamp else 0.00406235) * side**4 / rigidity + shear) - 1)


def twist_error(through: int, poisson: float, side: int = 6) -> float:
    """Return the error of the twist of a plate of thickness 1 m under twisting edge loads.

    The displacement k (-y z, -x z, x y) is exact.
    """
    lattice = box((side * through, side * through, through), 1 / through, poisson)
    x, y, z = (lattice.nodes - [side / 2, side / 2, 0.5]).T
    edge = np.isclose(abs(x), side / 2) | np.isclose(abs(y), side / 2)
    u = np.stack([-y * z, -x * z, x * y], axis=1)
    u, forces = solve(lattice, np.repeat(edge[:, None], 3, axis=1), u, np.zeros_like(u))
    exact = E / (2 * (1 + poisson)) * 4 * side**2 / 12
    return float(exact / (u * forces).sum() - 1)


# ---- beams


def beam(poisson: float, length: float, width: float, thickness: float) -> float:
    """Return the tip deflection of Timoshenko's beam under a unit force."""
    shear = 10 * (1 + poisson) / (12 + 11 * poisson) * E / (2 * (1 + poisson))
    area = width * thickness
    return 4 * length**3 / (E * area * thickness**2) + length / (shear * area)


def strip_error(thickness: float, poisson: float, length: int = 20, width: int = 3) -> float:
    """Return the error of bending of a strip in the middle of a layer of cells of 1 m."""
    mesh = trimesh.creation.box(bounds=np.array([[0, 0, 0], [length, width, thickness]]))
    lattice = lattice_of(mesh, 1.0, poisson=poisson, offset=(0, 0, (1 - thickness) / 2))
    tip = clamped(lattice, np.array([0.0, 0.0, 1.0]))
    return tip / beam(poisson, length, width, thickness) - 1


def bent_strip(
    thickness: float, degrees: float, poisson: float | None, length: int = 20, width: int = 3
) -> float:
    """Return the rotation of a strip's ends under moments, over the exact rotation.

    Cells have sides of 1 m. The strip is turned about its width, so its wall lies across the grid.
    """
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), (0, 1, 0))
    mesh = trimesh.creation.box((length, width, thickness)).apply_transform(turn)
    lattice = lattice_of(mesh, 1.0, poisson=poisson, offset=(0.3, 0.5, 0.7))
    middles = (np.arange(16) + 0.5) / 16 - 0.5
    y, z = (each.ravel() for each in np.meshgrid(width * middles, thickness * middles))
    f = np.zeros_like(lattice.nodes)
    for end in (-0.5, 0.5):
        # inside the strip by more than rounding
        face = np.column_stack([np.full(y.size, (1 - 1e-9) * end * length), y, z])
        pull = np.sign(end) * z[:, None] / (z**2).sum() * turn[:3, 0]
        f += spread(lattice, face @ turn[:3, :3].T, pull)
    K = hessian(lattice)
    # makes the singular K definite; f is in equilibrium
    K = K + 1e-10 * K.diagonal().max() * eye_array(f.size)
    turned = f.ravel() @ factorise(K)(f.ravel())
    return float(turned / (12 * length / (E * width * thickness**3)))


def spread(lattice: Lattice, points: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """Return the nodal forces (n, 3) [N] equivalent to forces at points (p, 3) [m]."""
    origin, f = lattice.nodes.min(axis=0), np.zeros_like(lattice.nodes)
    grid = np.rint((lattice.nodes - origin) / lattice.cell_size).astype(int)
    number = {tuple(place): node for node, place in enumerate(grid)}
    x = (points - origin) / lattice.cell_size
    first = np.floor(x).astype(int)
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, x - first, 1 - x + first).prod(axis=1)
        nodes = [number[tuple(place)] for place in first + corner]
        np.add.at(f, nodes, weight[:, None] * forces)
    return f


def fem_tip(poisson: float) -> float:
    """Return the tip deflection of a clamped beam under a unit force, by quadratic hexahedra."""
    x = LENGTH * np.linspace(0, 1, 25) ** 1.5
    mesh = skfem.MeshHex.init_tensor(x, np.linspace(0, 1, 5), np.linspace(0, 1, 5))
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHex2()), intorder=4)
    K = linear_elasticity(*lame_parameters(E, poisson)).assemble(basis)
    end = mesh.facets_satisfying(lambda x: np.isclose(x[0], LENGTH), boundaries_only=True)
    face = skfem.FacetBasis(mesh, basis.elem, facets=end, intorder=4)
    f = skfem.LinearForm(lambda v, _: v[2]).assemble(face)
    fixed = basis.get_dofs(mesh.facets_satisfying(lambda x: np.isclose(x[0], 0)))
    return float(f @ skfem.solve(*skfem.condense(K, f, D=fixed)))


def cantilever_error(across: int, poisson: float, exact: float | None = None) -> float:
    """Return the error of a square cantilever against hexahedra that are clamped alike.

    exact : deflection of the hexahedra; computed if None
    """
    lattice = box((LENGTH * across, across, across), 1 / across, poisson)
    exact = exact or fem_tip(poisson)
    return clamped(lattice, np.array([0.0, 0.0, 1.0])) / exact - 1
