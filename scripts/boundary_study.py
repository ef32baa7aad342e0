#!/usr/bin/env python3
"""What boundary cells do to a body: its mass, its sag and its frequencies, of whole cells and of their shares.

Bodies that do not lie along the grid, against elasticity; prints Markdown tables. Errors are relative, in percent: the
mean over places of the grid, and in brackets how far these are apart.
"""

from collections.abc import Callable, Iterable

from clone import parser

import numpy as np
import trimesh
from material_study import COMM, DENSITY, GRAVITY, NU, E, factorise, hessian, slope, table
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.sparse import diags
from scipy.sparse.linalg import LinearOperator, eigsh
from scipy.spatial.transform import Rotation
from scipy.special import spherical_jn

from msmpetsc.geometry.cages import Body, fill
from msmpetsc.geometry.surface import Surface, examine
from msmpetsc.model.lattice import Lattice, build_lattice

LENGTH, RADIUS, WIDTH = 0.5, 0.05, 0.1  # of bars and of the ball [m]
SHEAR = E / (2 * (1 + NU))  # [Pa]
OFFSETS = ((0.0, 0.0), (0.3, 0.7), (0.5, 0.5))  # of the grid across the bar [cells]
BOUNDARIES = ("whole", "fill")


def lattice_of(mesh: trimesh.Trimesh, h: float, boundary: str, offset: Iterable[float] = (0, 0, 0)) -> Lattice:
    """The lattice of a mesh in a grid that begins ``offset`` (3,) cells before it."""
    surface = Surface(np.array(mesh.vertices), np.array(mesh.faces))
    bounds = np.array([surface.points.min(axis=0) - h * np.array(offset), surface.points.max(axis=0)])
    cages = fill([Body(COMM, surface, examine(surface), bounds)], h, boundary=boundary)
    return build_lattice(cages, DENSITY, young_modulus=E)


def mass_error(lattice: Lattice, mesh: trimesh.Trimesh) -> float:
    return lattice.mass.sum() / (DENSITY * mesh.volume) - 1


# ---- bars clamped at x = 0


def round_bar() -> trimesh.Trimesh:
    """Along x; its circle has 256 sides, which take 0.02% of its stiffness."""
    return along_x(trimesh.creation.cylinder(RADIUS, LENGTH, sections=256))


def turned_bar() -> trimesh.Trimesh:
    """A square bar along x, turned by 30 degrees about it."""
    bar = along_x(trimesh.creation.box((WIDTH, WIDTH, LENGTH)))
    bar.apply_transform(trimesh.transformations.rotation_matrix(np.radians(30), (1, 0, 0)))
    return bar


def along_x(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh.vertices = mesh.vertices[:, [2, 0, 1]] + [LENGTH / 2, 0, 0]
    return mesh


def timoshenko_sag(area: float, second_moment: float, kappa: float) -> float:
    """Tip deflection [m] under the weight; kappa by Cowper (1966)."""
    w = DENSITY * area * GRAVITY
    return w * LENGTH**4 / (8 * E * second_moment) + w * LENGTH**2 / (2 * kappa * SHEAR * area)


ROUND_SAG = timoshenko_sag(np.pi * RADIUS**2, np.pi * RADIUS**4 / 4, 6 * (1 + NU) / (7 + 6 * NU))
SQUARE_SAG = timoshenko_sag(WIDTH**2, WIDTH**4 / 12, 10 * (1 + NU) / (12 + 11 * NU))


def sag(lattice: Lattice) -> float:
    """Mean tip deflection [m] under its weight."""
    x, mass = np.repeat(lattice.nodes[:, 0], 3), np.repeat(lattice.mass, 3)
    vertical, free, u = np.tile([False, False, True], len(lattice.nodes)), ~np.isclose(x, 0), np.zeros(len(x))
    u[free] = factorise(hessian(lattice)[free][:, free])(-(GRAVITY * mass * vertical)[free])
    return -u[vertical & np.isclose(x, LENGTH)].mean()


def bar_errors(mesh: trimesh.Trimesh, exact: float, h: float, boundary: str) -> tuple[int, np.ndarray, np.ndarray]:
    """Cells, and errors of sag and mass in the places of the grid."""
    lattices = [lattice_of(mesh, h, boundary, (0, *offset)) for offset in OFFSETS]
    errors = [(sag(lattice) / exact - 1, mass_error(lattice, mesh)) for lattice in lattices]
    return len(lattices[0].cells), *np.transpose(errors)


# ---- frequencies of free bodies


def frequencies(lattice: Lattice, count: int) -> np.ndarray:
    """The lowest frequencies [rad/s] above the six rigid motions."""
    mass = np.repeat(lattice.mass, 3)
    K = hessian(lattice)
    shift = -1e-4 * E / (DENSITY * LENGTH**2)  # so that it can be factorised
    inverse = LinearOperator(K.shape, factorise((K - shift * diags(mass)).tocsc()))
    squares = eigsh(K, k=6 + count, M=diags(mass), sigma=shift, OPinv=inverse, v0=np.ones(len(mass)))[0]
    return np.sqrt(np.sort(squares)[6:])


def ball_error(h: float, boundary: str) -> tuple[int, float, float]:
    """Cells, and errors of the lowest frequency and of the mass of a ball.

    Lamb (1882): the lowest five are torsional of degree 2, where j_2(x) = x j_3(x), x = omega R / c_s.
    """
    ball = trimesh.creation.icosphere(5, RADIUS)
    root = brentq(lambda x: spherical_jn(2, x) - x * spherical_jn(3, x), 2, 3)
    lattice = lattice_of(ball, h, boundary, (0.3, 0.7, 0.5))
    exact = root * np.sqrt(SHEAR / DENSITY) / RADIUS
    return len(lattice.cells), frequencies(lattice, 5).mean() / exact - 1, mass_error(lattice, ball)


def tilted_bar_error(h: float, boundary: str) -> tuple[int, float, float]:
    """Cells, and errors of the first bending frequency and of the mass of a free square bar askew in the grid."""
    bar = trimesh.creation.box((LENGTH, WIDTH, WIDTH))
    bar.vertices = Rotation.from_rotvec([0.3, 0.5, 0.4]).apply(bar.vertices)
    lattice = lattice_of(bar, h, boundary)
    return len(lattice.cells), frequencies(lattice, 2).mean() / free_bar_frequency() - 1, mass_error(lattice, bar)


def free_bar_frequency() -> float:
    """First bending frequency [rad/s] of the free square bar, by Timoshenko.

    (w, phi, M, V)' = B (w, phi, M, V), in units of the bar; M = V = 0 at both ends: the block of exp(B L) that takes
    w, phi at one end to M, V at the other is singular.
    """
    EI, kGA = E * WIDTH**4 / 12, 10 * (1 + NU) / (12 + 11 * NU) * SHEAR * WIDTH**2
    line_mass, line_inertia = DENSITY * WIDTH**2, DENSITY * WIDTH**4 / 12

    def end(omega: float) -> float:
        B = np.zeros((4, 4))
        B[0, 1], B[0, 3], B[1, 2] = 1, 1 / kGA, 1 / EI
        B[2, 1], B[2, 3], B[3, 0] = -line_inertia * omega**2, -1, -line_mass * omega**2
        return np.linalg.det(expm(B * LENGTH)[2:, :2])

    slender = 4.73004**2 * np.sqrt(EI / line_mass) / LENGTH**2  # Euler-Bernoulli's
    return brentq(end, 0.5 * slender, slender, xtol=1e-10 * slender)


def sheet_errors(thickness: float, boundary: str) -> tuple[float, float]:
    """Errors of the mass of a sheet of so many cells, in the middle of a layer of them, and of its bending stiffness.

    The stiffness is that of a cylinder that a moment bends: from the strain energy of u_x = x z, u_z = -x^2/2, and of
    u_z = 0 along y, which a plate has so that E/(1 - nu^2) tau^3/12 a width.
    """
    h = WIDTH / 8
    sheet = trimesh.creation.box((3 * WIDTH, 3 * WIDTH, thickness * h))
    sheet.vertices += [0, 0, 1.5 * h]
    bounds_below = np.array([0, 0, (1.5 - thickness / 2)])
    lattice = lattice_of(sheet, h, boundary, bounds_below)
    x, _, z = (lattice.nodes - [0, 0, 1.5 * h]).T
    u = np.stack([x * z, 0 * x, -(x**2) / 2], axis=1).ravel()
    exact = E / (1 - NU**2) * (thickness * h) ** 3 / 12 * (3 * WIDTH) ** 2
    return mass_error(lattice, sheet), u @ (hessian(lattice) @ u) / exact - 1


# ---- the tables


def percent(value: float, digits: int = 1) -> str:
    return f"{100 * value:+.{digits}f}%"


def spread(errors: np.ndarray) -> str:
    return f"{percent(errors.mean())} ({100 * np.ptp(errors):.1f})"


def bar_table(name: str, mesh: trimesh.Trimesh, exact: float, sizes: tuple[float, ...]) -> None:
    rows, means = [], []
    for size in sizes:
        found = {boundary: bar_errors(mesh, exact, size * RADIUS, boundary) for boundary in BOUNDARIES}
        means.append([found[boundary][1].mean() for boundary in BOUNDARIES])
        texts = [text for boundary in BOUNDARIES for text in map(spread, found[boundary][1:])]
        rows.append((f"{size:.3f}", found["fill"][0], *texts))
    slopes = [f"{slope(sizes, errors):.2f}" for errors in np.transpose(means)]
    rows.append(("slope", "", slopes[0], "", slopes[1], ""))
    table([f"{name}, h / R", "cells", "whole: sag", "mass", "fill: sag", "mass"], rows)


def frequency_table(
    name: str, error: Callable[[float, str], tuple[int, float, float]], sizes: tuple[float, ...]
) -> None:
    rows = []
    for size in sizes:
        found = {boundary: error(size * RADIUS, boundary) for boundary in BOUNDARIES}
        texts = [percent(value) for boundary in BOUNDARIES for value in found[boundary][1:]]
        rows.append((f"{size:.3f}", found["fill"][0], *texts))
    table([f"{name}, h / R", "cells", "whole: frequency", "mass", "fill: frequency", "mass"], rows)


def sheet_table() -> None:
    rows = []
    for thickness in (0.1, 0.25, 0.5, 0.8):
        errors = [text for boundary in BOUNDARIES for text in map(factor, sheet_errors(thickness, boundary))]
        rows.append((thickness, *errors))
    table(["a sheet within one layer, thickness / h", "whole: mass", "stiffness", "fill: mass", "stiffness"], rows)


def factor(error: float) -> str:
    return f"x {1 + error:.3g}"


def main() -> None:
    parser(__doc__).parse_args()
    bar_table("round bar", round_bar(), ROUND_SAG, (2 / 3, 0.4, 1 / 3, 1 / 4, 1 / 6))
    bar_table("square bar turned by 30 degrees", turned_bar(), SQUARE_SAG, (0.5, 1 / 3, 1 / 4, 1 / 6))
    frequency_table("free square bar askew", tilted_bar_error, (0.5, 1 / 3, 1 / 4))
    frequency_table("ball", ball_error, (0.4, 1 / 4, 1 / 6, 1 / 8))
    sheet_table()


if __name__ == "__main__":
    main()
