"""Bodies at small strain against elasticity: bars along the grid and askew.

Static problems and eigenfrequencies use the Hessian of E at rest. All errors are relative.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
import trimesh
from mpi4py import MPI
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.sparse import coo_array, csc_array, diags
from scipy.sparse.linalg import LinearOperator, eigsh, splu
from surfaces import body_of

from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.geometry.cages import fill
from msmpetsc.lattice.lattice import Lattice, build_lattice
from msmpetsc.scene.body import Material
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.presets import find_preset

# [Pa], [-], [kg/m^3], [m/s^2]
E, NU, DENSITY, GRAVITY = 1e6, 1 / 4, 1000.0, 9.81
# [Pa]
SHEAR = E / (2 * (1 + NU))
# shear coefficients of a square and of a circle; Cowper (1966)
KAPPA_SQUARE = 10 * (1 + NU) / (12 + 11 * NU)
KAPPA_ROUND = 6 * (1 + NU) / (7 + 6 * NU)
# width of the beam [m], and its length in widths
WIDTH, BEAM = 0.1, 10
# cells across the beam
ACROSS = (2, 4, 6, 8)
# length of bars not along the grid, radius of the round bar and of the ball [m]
LENGTH, RADIUS = 0.5, 0.05
# offsets of the grid across the bar [cells]
OFFSETS = ((0.0, 0.0), (0.3, 0.7), (0.5, 0.5))
# a value of Poisson's ratio that stands for springs instead of a neo-Hookean solid
SPRINGS = None
LAWS = {"springs": SPRINGS, "neo-Hookean": NU}
# treatment of boundary cells, and law
KINDS = {"whole": ("whole", SPRINGS), "fill": ("fill", SPRINGS), "neo-Hookean": ("fill", NU)}


# ---- lattices, and the Hessian at rest


def lattice_of(
    mesh: trimesh.Trimesh,
    h: float,
    boundary: str = "fill",
    poisson: float | None = SPRINGS,
    offset: Iterable[float] = (0, 0, 0),
) -> Lattice:
    """Return the lattice of a mesh in a grid that begins ``offset`` (3,) cells before the mesh."""
    body = body_of(mesh)
    body.bounds[0] -= h * np.array(offset)
    cages = fill([body], h, boundary=boundary)
    material = {"density": DENSITY, "young_modulus": E} | law_of(poisson)
    return build_lattice(cages, Material.model_validate(material))


def law_of(poisson: float | None) -> dict[str, Any]:
    """Return the law of a neo-Hookean solid of Poisson's ratio, or of springs."""
    springs = {"law": "linear"}
    return springs if poisson is SPRINGS else {"law": "neo-hookean", "poisson_ratio": poisson}


def box(cells: Iterable[int], cell_size: float, poisson: float | None = SPRINGS) -> Lattice:
    """Return the lattice of a box of exactly these cells, with its low corner at the origin."""
    mesh = trimesh.creation.box(bounds=[np.zeros(3), np.array([*cells]) * cell_size])
    return lattice_of(mesh, cell_size, poisson=poisson)


def hessian(lattice: Lattice, q: np.ndarray | None = None) -> csc_array:
    """Return the Hessian of E (3n, 3n) [N/m] at positions q (n, 3), or at rest, from 81 products.

    Nodes three cells apart share no cell, so one product serves all nodes of a colour.
    """
    n = len(lattice.nodes)
    ijk = np.rint((lattice.nodes - lattice.nodes.min(axis=0)) / lattice.cell_size).astype(int)
    colour = ijk % 3 @ [9, 3, 1]
    product = Elasticity(lattice).hessian_at(lattice.nodes if q is None else q)
    triplets = []
    neighbours = csc_array(
        (
            np.ones(8 * len(lattice.cells)),
            lattice.cells.ravel(),
            8 * np.arange(len(lattice.cells) + 1),
        )
    )
    pairs = (neighbours @ neighbours.T).tocoo()
    for c in range(27):
        used = colour[pairs.col] == c
        for axis in range(3):
            v, column = np.zeros((2, n, 3))
            v[colour == c, axis] = 1
            product.add_product(v, column)
            for k in range(3):
                triplets.append(
                    (
                        column[pairs.row[used], k],
                        3 * pairs.row[used] + k,
                        3 * pairs.col[used] + axis,
                    )
                )
    values, rows, columns = np.concatenate(triplets, axis=1)
    return coo_array(
        (values, (rows.astype(int), columns.astype(int))), shape=(3 * n, 3 * n)
    ).tocsc()


def factorise(K: csc_array) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function f -> K^(-1) f of a symmetric positive definite matrix."""
    return splu(
        csc_array(K),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    ).solve


# ---- Timoshenko's beams


class Section(NamedTuple):
    """Section: E I [N m^2], kappa G A [N], rho A [kg/m] and rho I [kg m] of a beam."""

    EI: float
    kGA: float
    line_mass: float
    line_inertia: float


def section(area: float, second_moment: float, kappa: float) -> Section:
    """Return the section of an area [m^2], a second moment [m^4] and a shear coefficient."""
    return Section(E * second_moment, kappa * SHEAR * area, DENSITY * area, DENSITY * second_moment)


def beam_section(across: float = np.inf) -> Section:
    """Return the section of the square beam, or of its lattice with ``across`` cells across.

    A cell's edges stay straight. The displacements u_x = c x z and u_y = -nu c y z of its corners
    stretch edges and face diagonals (k1 : k2 = 40 : 16). Their energy per volume sums to 103/560 E
    c^2 h^2 / 2, while bending has 1/12 E c^2 h^2 / 2. So E I grows by 1 + 169/140 (h/b)^2. Masses
    at the corners increase rho I by 1 + 2 (h/b)^2.
    """
    solid = section(WIDTH**2, WIDTH**4 / 12, KAPPA_SQUARE)
    ratio = 1 / across**2
    return solid._replace(
        EI=solid.EI * (1 + 169 / 140 * ratio), line_inertia=solid.line_inertia * (1 + 2 * ratio)
    )


def tip_sag(beam: Section, length: float) -> float:
    """Return the tip deflection [m] of a cantilever under its weight w [N/m].

    w L^4 / (8 E I) + w L^2 / (2 kappa G A)
    """
    w = beam.line_mass * GRAVITY
    return w * length**4 / (8 * beam.EI) + w * length**2 / (2 * beam.kGA)


def timoshenko_sag(across: float = np.inf) -> float:
    """Return the tip deflection [m] of the beam as a cantilever under its weight."""
    return tip_sag(beam_section(across), BEAM * WIDTH)


def timoshenko_frequency(across: float = np.inf) -> float:
    """Return the first bending frequency [Hz] of the beam as a cantilever.

    Along x, (w, phi, M, V)' = B (w, phi, M, V). At the clamp w = phi = 0, at the free end M = V =
    0. So the block of exp(B L) that maps M, V from the clamp to the free end is singular.
    """
    beam = beam_section(across)
    length = BEAM * WIDTH

    def end(omega: float) -> float:
        B = np.zeros((4, 4))
        B[0, 1], B[0, 3], B[1, 2] = 1, 1 / beam.kGA, 1 / beam.EI
        B[2, 1], B[2, 3], B[3, 0] = -beam.line_inertia * omega**2, -1, -beam.line_mass * omega**2
        return np.linalg.det(expm(B * length)[2:, 2:])

    # Euler-Bernoulli's frequency [rad/s], an upper bound
    slender = 1.8751**2 * np.sqrt(beam.EI / beam.line_mass) / length**2
    return brentq(end, 0.5 * slender, 1.1 * slender, xtol=1e-12 * slender) / (2 * np.pi)


ROUND_SAG = tip_sag(section(np.pi * RADIUS**2, np.pi * RADIUS**4 / 4, KAPPA_ROUND), LENGTH)
SQUARE_SAG = tip_sag(beam_section(), LENGTH)


# ---- a clamped beam


class Clamped:
    """A lattice clamped at x = 0: the Hessian (f, f) of the free components, and its inverse."""

    def __init__(self, lattice: Lattice):
        self.lattice = lattice
        self.free = np.repeat(~np.isclose(lattice.nodes[:, 0], 0), 3)
        self.K = hessian(lattice)[self.free][:, self.free]
        self.inverse = factorise(self.K)

    def sag(self, length: float) -> float:
        """Return the mean tip deflection [m] under the weight, by linear theory."""
        weight = np.zeros_like(self.lattice.nodes)
        u = np.zeros(self.lattice.nodes.size)
        weight[:, 2] = -GRAVITY * self.lattice.mass
        u[self.free] = self.inverse(weight.ravel()[self.free])
        return -u.reshape(-1, 3)[np.isclose(self.lattice.nodes[:, 0], length), 2].mean()

    def frequency(self) -> float:
        """Return the first bending frequency [Hz]."""
        # the eigenvalue is double; a fixed start makes the result reproducible
        modes = {
            "OPinv": LinearOperator(self.K.shape, self.inverse),
            "v0": np.ones(self.K.shape[0]),
        }
        M = diags(np.repeat(self.lattice.mass, 3)[self.free])
        squares = eigsh(self.K, k=2, M=M, sigma=0, return_eigenvectors=False, **modes)
        return np.sqrt(squares.min()) / (2 * np.pi)


def lattice_beam(across: int, poisson: float | None = SPRINGS) -> tuple[float, float]:
    """Return the tip deflection [m] and the first bending frequency [Hz] of a beam's lattice."""
    clamped = Clamped(box((BEAM * across, across, across), WIDTH / across, poisson))
    return clamped.sag(BEAM * WIDTH), clamped.frequency()


# ---- steps of the program


def steps(
    lattice: Lattice,
    t: float,
    q: np.ndarray,
    before: np.ndarray,
    loads: Iterable[np.ndarray],
    error: float,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield q_(n+1) and q_n after each load (n, 3) [N], starting from q_n and q_(n-1)."""
    stepper = Stepper(MPI.COMM_SELF, lattice, t, find_preset("newton"), error=error)
    try:
        for load in loads:
            q, before = stepper.step(StepProblem(q, 2 * q - before, load)).position, q
            yield q, before
    finally:
        stepper.destroy()


# ---- bodies that do not lie along the grid


def mass_error(lattice: Lattice, mesh: trimesh.Trimesh) -> float:
    """Return the relative error of a lattice's mass."""
    return lattice.mass.sum() / (DENSITY * mesh.volume) - 1


def along_x(mesh: trimesh.Trimesh, degrees: float = 0.0) -> trimesh.Trimesh:
    """Return a bar of LENGTH along z, laid along x from x = 0 and turned about the x axis."""
    mesh.vertices = mesh.vertices[:, [2, 0, 1]] + [LENGTH / 2, 0, 0]
    return mesh.apply_transform(
        trimesh.transformations.rotation_matrix(np.radians(degrees), (1, 0, 0))
    )


def round_bar() -> trimesh.Trimesh:
    """Return a round bar; its 256 sides reduce the stiffness by 0.02%."""
    return along_x(trimesh.creation.cylinder(RADIUS, LENGTH, sections=256))


def turned_bar() -> trimesh.Trimesh:
    """Return a square bar turned by 30 degrees about its axis."""
    return along_x(trimesh.creation.box((WIDTH, WIDTH, LENGTH)), degrees=30)


def bar_errors(
    mesh: trimesh.Trimesh, exact: float, h: float, kind: str
) -> tuple[int, np.ndarray, np.ndarray]:
    """Return the number of cells, and the errors of sag and mass for each offset of the grid."""
    lattices = [lattice_of(mesh, h, *KINDS[kind], offset=(0, *offset)) for offset in OFFSETS]
    errors = [
        (Clamped(lattice).sag(LENGTH) / exact - 1, mass_error(lattice, mesh))
        for lattice in lattices
    ]
    return len(lattices[0].cells), *np.transpose(errors)
