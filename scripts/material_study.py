#!/usr/bin/env python3
"""Both laws against elasticity at small strain, Poisson's ratio 1/4.

    scripts/material_study.py [beam wave round turned ball]

Of boxes that lie along the grid: a clamped beam, a wave. Of bodies that do not, whole boundary cells
beside those by their fill, and the neo-Hookean solid: clamped bars, round and turned, and the frequency of a ball; of
bars the mean over places of the grid, and in brackets how far these are apart. Static problems and eigenfrequencies
use the Hessian of E at rest, the wave the product's own steps. All errors are relative.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import lab
from lab import percent, slope

import numpy as np
import trimesh
from mpi4py import MPI
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.sparse import coo_array, csc_array, diags
from scipy.sparse.linalg import LinearOperator, eigsh, splu
from scipy.special import spherical_jn

from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.geometry.cages import BodySurface, fill
from msmpetsc.geometry.surface import Surface, examine
from msmpetsc.lattice.lattice import Lattice, build_lattice
from msmpetsc.scene.body import Material
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.presets import find_preset

E, NU, DENSITY, GRAVITY = 1e6, 1 / 4, 1000.0, 9.81  # [Pa], [-], [kg/m^3], [m/s^2]
SHEAR = E / (2 * (1 + NU))  # [Pa]
KAPPA_SQUARE, KAPPA_ROUND = (
    10 * (1 + NU) / (12 + 11 * NU),
    6 * (1 + NU) / (7 + 6 * NU),
)  # Cowper (1966)
WIDTH, BEAM = 0.1, 10  # of the beam [m], and its length in widths
ACROSS = (2, 4, 6, 8)  # cells across the beam
LENGTH, RADIUS = 0.5, 0.05  # of bars that do not lie along the grid, and of the ball [m]
OFFSETS = ((0.0, 0.0), (0.3, 0.7), (0.5, 0.5))  # of the grid across the bar [cells]
SPRINGS = None  # in place of Poisson's ratio of a neo-Hookean solid
LAWS = {"springs": SPRINGS, "neo-Hookean": NU}
KINDS = {
    "whole": ("whole", SPRINGS),
    "fill": ("fill", SPRINGS),
    "neo-Hookean": ("fill", NU),
}  # of boundary cells


# ---- lattices, and the Hessian at rest


def lattice_of(
    mesh: trimesh.Trimesh,
    h: float,
    boundary: str = "fill",
    poisson: float | None = SPRINGS,
    offset: Iterable[float] = (0, 0, 0),
) -> Lattice:
    """The lattice of a mesh in a grid that begins ``offset`` (3,) cells before it."""
    surface = Surface(np.array(mesh.vertices), np.array(mesh.faces))
    bounds = np.array(
        [surface.points.min(axis=0) - h * np.array(offset), surface.points.max(axis=0)]
    )
    cages = fill(
        [BodySurface(MPI.COMM_SELF, surface, examine(surface), bounds)], h, boundary=boundary
    )
    law = (
        {"law": "linear"}
        if poisson is SPRINGS
        else {"law": "neo-hookean", "poisson_ratio": poisson}
    )
    return build_lattice(
        cages, Material.model_validate({"density": DENSITY, "young_modulus": E} | law)
    )


def box(cells: Iterable[int], cell_size: float, poisson: float | None = SPRINGS) -> Lattice:
    """The lattice of a box filled with exactly these cells, its low corner at the origin."""
    mesh = trimesh.creation.box(bounds=[np.zeros(3), np.array([*cells]) * cell_size])
    return lattice_of(mesh, cell_size, poisson=poisson)


def hessian(lattice: Lattice) -> csc_array:
    """Hessian of E at rest (3n, 3n) [N/m], from its products: nodes three cells apart share no cell."""
    n, ijk = (
        len(lattice.nodes),
        np.rint((lattice.nodes - lattice.nodes.min(axis=0)) / lattice.cell_size).astype(int),
    )
    colour, product, triplets = (
        ijk % 3 @ [9, 3, 1],
        Elasticity(lattice).hessian_at(lattice.nodes),
        [],
    )
    neighbours = csc_array(
        (
            np.ones(8 * len(lattice.cells)),
            lattice.cells.ravel(),
            8 * np.arange(len(lattice.cells) + 1),
        )
    )
    pairs = (neighbours @ neighbours.T).tocoo()
    for c in range(27):
        of = colour[pairs.col] == c
        for axis in range(3):
            v, column = np.zeros((2, n, 3))
            v[colour == c, axis] = 1
            product.add_product(v, column)
            for k in range(3):
                triplets.append(
                    (column[pairs.row[of], k], 3 * pairs.row[of] + k, 3 * pairs.col[of] + axis)
                )
    values, rows, columns = np.concatenate(triplets, axis=1)
    return coo_array(
        (values, (rows.astype(int), columns.astype(int))), shape=(3 * n, 3 * n)
    ).tocsc()


def factorise(K: csc_array) -> Callable[[np.ndarray], np.ndarray]:
    """f -> K^(-1) f, K symmetric positive definite."""
    return splu(
        csc_array(K),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    ).solve


# ---- Timoshenko's beams


class Section(NamedTuple):
    """E I [N m^2], kappa G A [N], rho A [kg/m], rho I [kg m] of a beam."""

    EI: float
    kGA: float
    line_mass: float
    line_inertia: float


def section(area: float, second_moment: float, kappa: float) -> Section:
    return Section(E * second_moment, kappa * SHEAR * area, DENSITY * area, DENSITY * second_moment)


def beam_section(across: float = np.inf) -> Section:
    """The square beam's section.

    across : for the lattice so many cells across. A cell cannot curve between its corners: their displacements
             u_x = c x z, u_y = -nu c y z stretch edges and face diagonals (k1 : k2 = 40 : 16) by energies that add
             up to 103/560 E c^2 h^2 / 2 a volume where bending has 1/12, so E I grows by 1 + 169/140 (h/b)^2.
             And its masses sit at corners: rho I grows by 1 + 2 (h/b)^2.
    """
    solid, ratio = section(WIDTH**2, WIDTH**4 / 12, KAPPA_SQUARE), 1 / across**2
    return solid._replace(
        EI=solid.EI * (1 + 169 / 140 * ratio), line_inertia=solid.line_inertia * (1 + 2 * ratio)
    )


def tip_sag(of: Section, length: float) -> float:
    """Tip deflection [m] of a beam clamped at one end, under its weight: w L^4 / (8 E I) + w L^2 / (2 kappa G A)."""
    w = of.line_mass * GRAVITY
    return w * length**4 / (8 * of.EI) + w * length**2 / (2 * of.kGA)


def timoshenko_sag(across: float = np.inf) -> float:
    """Tip deflection [m] of the beam clamped at one end, under its weight."""
    return tip_sag(beam_section(across), BEAM * WIDTH)


def timoshenko_frequency(across: float = np.inf) -> float:
    """First bending frequency [Hz] of the beam clamped at one end.

    (w, phi, M, V)' = B (w, phi, M, V) along x; w = phi = 0 at the clamp, and M = V = 0 at the free end: the block
    of exp(B L) that takes M, V there from those at the clamp is singular.
    """
    of, length = beam_section(across), BEAM * WIDTH

    def end(omega: float) -> float:
        B = np.zeros((4, 4))
        B[0, 1], B[0, 3], B[1, 2] = 1, 1 / of.kGA, 1 / of.EI
        B[2, 1], B[2, 3], B[3, 0] = -of.line_inertia * omega**2, -1, -of.line_mass * omega**2
        return np.linalg.det(expm(B * length)[2:, 2:])

    slender = (
        1.8751**2 * np.sqrt(of.EI / of.line_mass) / length**2
    )  # Euler-Bernoulli's [rad/s], a little higher
    return brentq(end, 0.5 * slender, 1.1 * slender, xtol=1e-12 * slender) / (2 * np.pi)


ROUND_SAG = tip_sag(section(np.pi * RADIUS**2, np.pi * RADIUS**4 / 4, KAPPA_ROUND), LENGTH)
SQUARE_SAG = tip_sag(beam_section(), LENGTH)


# ---- a clamped beam


class Clamped:
    """A lattice whose nodes at x = 0 are held: the Hessian (f, f) of the others and its inverse."""

    def __init__(self, lattice: Lattice):
        self.lattice, self.free = lattice, np.repeat(~np.isclose(lattice.nodes[:, 0], 0), 3)
        self.K = hessian(lattice)[self.free][:, self.free]
        self.inverse = factorise(self.K)

    def sag(self, length: float) -> float:
        """Mean tip deflection [m] under the weight; linear, so that it does not matter how large it is."""
        weight, u = np.zeros_like(self.lattice.nodes), np.zeros(self.lattice.nodes.size)
        weight[:, 2] = -GRAVITY * self.lattice.mass
        u[self.free] = self.inverse(weight.ravel()[self.free])
        return -u.reshape(-1, 3)[np.isclose(self.lattice.nodes[:, 0], length), 2].mean()

    def frequency(self) -> float:
        """First bending frequency [Hz]."""
        # bending along y and along z are one double eigenvalue; a start that is given keeps the figures the same
        modes = {
            "OPinv": LinearOperator(self.K.shape, self.inverse),
            "v0": np.ones(self.K.shape[0]),
        }
        M = diags(np.repeat(self.lattice.mass, 3)[self.free])
        squares = eigsh(self.K, k=2, M=M, sigma=0, return_eigenvectors=False, **modes)
        return np.sqrt(squares.min()) / (2 * np.pi)


def lattice_beam(across: int, poisson: float | None = SPRINGS) -> tuple[float, float]:
    """Tip deflection [m] under its weight and first bending frequency [Hz] of the beam of so many cells across."""
    clamped = Clamped(box((BEAM * across, across, across), WIDTH / across, poisson))
    return clamped.sag(BEAM * WIDTH), clamped.frequency()


# ---- steps of the product: a compression wave in a bar


def steps(
    lattice: Lattice,
    t: float,
    q: np.ndarray,
    before: np.ndarray,
    loads: Iterable[np.ndarray],
    error: float,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """q_(n+1) and q_n, one pair for each of the loads (n, 3) [N]; from q_n and q_(n-1)."""
    stepper = Stepper(MPI.COMM_SELF, lattice, t, find_preset("newton"), error=error)
    try:
        for load in loads:
            q, before = stepper.step(StepProblem(q, 2 * q - before, load)).position, q
            yield q, before
    finally:
        stepper.destroy()


BAR, STATIONS = 120, (30, 80)  # its length and where it is watched [cells]; two cells wide, WIDTH
CELL = WIDTH / 2
SPEED = np.sqrt(E / DENSITY)  # of long waves in a thin bar [m/s]
PULSE = 5 * CELL / SPEED  # standard deviation of the blow [s]
STRAIN = 1e-4  # changes the speed by 0.17 of it, measured


def struck_bar(courant: float, poisson: float | None = SPRINGS) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) [s] and mean axial velocities (T, 2) [m/s] at the two stations of a bar struck at one end.

    The blow is a Gaussian in time. In a time step the wave goes ``courant`` cells far; the last time lies before
    the echo from the far end.
    """
    lattice, t = box((BAR, 2, 2), CELL, poisson), courant * CELL / SPEED
    section = np.rint(lattice.nodes[:, 0] / CELL)
    force = np.zeros_like(lattice.nodes)
    end = section == 0
    force[end, 0] = STRAIN * E * WIDTH**2 * lattice.mass[end] / lattice.mass[end].sum()
    times = t * np.arange(1, round((STATIONS[1] + 60) / courant))
    blows = (np.exp(-0.5 * (time / PULSE - 5) ** 2) * force for time in times)
    motion = steps(lattice, t, lattice.nodes, lattice.nodes, blows, error=1e-5)
    return times, np.array(
        [[(q - p)[section == s, 0].mean() / t for s in STATIONS] for q, p in motion]
    )


def wave_speeds(times: np.ndarray, v: np.ndarray) -> tuple[float, float, float]:
    """Errors of the speeds of a pulse's centre and of its peak, and what is left of its height."""
    centre, peak = times @ v / v.sum(axis=0), []
    for column in v.T:  # the top of a parabola through the three highest values
        near = column.argmax() + np.arange(-1, 2)
        a, b, _ = np.polyfit(times[near] - times[near[1]], column[near], 2)
        peak.append(times[near[1]] - b / (2 * a))
    of_centre, of_peak = np.diff(STATIONS) * CELL / np.diff([centre, peak])[:, 0] / SPEED - 1
    return of_centre, of_peak, v[:, 1].max() / v[:, 0].max()


# ---- bodies that do not lie along the grid


def mass_error(lattice: Lattice, mesh: trimesh.Trimesh) -> float:
    return lattice.mass.sum() / (DENSITY * mesh.volume) - 1


def along_x(mesh: trimesh.Trimesh, degrees: float = 0.0) -> trimesh.Trimesh:
    """A bar of LENGTH along z, laid along x and turned about it."""
    mesh.vertices = mesh.vertices[:, [2, 0, 1]] + [LENGTH / 2, 0, 0]
    return mesh.apply_transform(
        trimesh.transformations.rotation_matrix(np.radians(degrees), (1, 0, 0))
    )


def round_bar() -> trimesh.Trimesh:
    """Its circle has 256 sides, which take 0.02% of its stiffness."""
    return along_x(trimesh.creation.cylinder(RADIUS, LENGTH, sections=256))


def turned_bar() -> trimesh.Trimesh:
    """A square bar."""
    return along_x(trimesh.creation.box((WIDTH, WIDTH, LENGTH)), degrees=30)


def bar_errors(
    mesh: trimesh.Trimesh, exact: float, h: float, kind: str
) -> tuple[int, np.ndarray, np.ndarray]:
    """Cells, and errors of sag and mass in the places of the grid."""
    lattices = [lattice_of(mesh, h, *KINDS[kind], offset=(0, *offset)) for offset in OFFSETS]
    errors = [
        (Clamped(lattice).sag(LENGTH) / exact - 1, mass_error(lattice, mesh))
        for lattice in lattices
    ]
    return len(lattices[0].cells), *np.transpose(errors)


def frequencies(lattice: Lattice, count: int) -> np.ndarray:
    """The lowest frequencies [rad/s] above the six rigid motions."""
    mass = np.repeat(lattice.mass, 3)
    K = hessian(lattice)
    shift = -1e-4 * E / (DENSITY * LENGTH**2)  # so that it can be factorised
    inverse = LinearOperator(K.shape, factorise((K - shift * diags(mass)).tocsc()))
    squares = eigsh(
        K, k=6 + count, M=diags(mass), sigma=shift, OPinv=inverse, v0=np.ones(len(mass))
    )[0]
    return np.sqrt(np.sort(squares)[6:])


def ball_error(h: float, kind: str) -> tuple[int, float, float]:
    """Cells, and errors of the lowest frequency and of the mass of a ball.

    Lamb (1882): the lowest five are torsional of degree 2, where j_2(x) = x j_3(x), x = omega R / c_s.
    """
    ball = trimesh.creation.icosphere(5, RADIUS)
    root = brentq(lambda x: spherical_jn(2, x) - x * spherical_jn(3, x), 2, 3)
    lattice = lattice_of(ball, h, *KINDS[kind], offset=(0.3, 0.7, 0.5))
    exact = root * np.sqrt(SHEAR / DENSITY) / RADIUS
    return len(lattice.cells), frequencies(lattice, 5).mean() / exact - 1, mass_error(lattice, ball)


# ---- the tables


def beam_rows(poisson: float | None) -> lab.Rows:
    exact_sag, exact_frequency, errors = timoshenko_sag(), timoshenko_frequency(), []
    for across in ACROSS:
        sag, frequency = lattice_beam(across, poisson)
        row = {"deflection": sag / exact_sag - 1, "frequency": frequency / exact_frequency - 1}
        if poisson is SPRINGS:
            row["expected"] = timoshenko_sag(across) / exact_sag - 1
            row["expected frequency"] = timoshenko_frequency(across) / exact_frequency - 1
        errors.append([*row.values()])
        yield {"cells across": across} | {name: percent(x, 2) for name, x in row.items()}
    slopes = (f"{slope(1 / np.array(ACROSS), error):.2f}" for error in np.transpose(errors))
    yield {"cells across": "slope"} | dict(zip(row, slopes, strict=True))


def wave_rows(poisson: float | None) -> lab.Rows:
    for courant in (1 / 4, 1 / 8, 1 / 16):
        centre, peak, height = wave_speeds(*struck_bar(courant, poisson))
        speeds = {"centre": percent(centre, 4), "peak": percent(peak, 2)}
        yield {"c t / h": courant} | speeds | {"height left": f"{height:.2f}"}


def of_both(rows: Callable[[float | None], lab.Rows]) -> lab.Rows:
    """Rows of both laws."""
    for name, poisson in LAWS.items():
        yield from ({"law": name, **row} for row in rows(poisson))


def bar_rows(mesh: trimesh.Trimesh, exact: float, sizes: tuple[float, ...]) -> lab.Rows:
    means = []
    for size in sizes:
        found = {kind: bar_errors(mesh, exact, size * RADIUS, kind) for kind in KINDS}
        means.append([found[kind][1].mean() for kind in KINDS])
        row: dict[str, object] = {"h / R": f"{size:.3f}", "cells": found["fill"][0]}
        for kind, (_, *errors) in found.items():
            texts = (f"{percent(error.mean())} ({100 * np.ptp(error):.1f})" for error in errors)
            row |= dict(zip((f"{kind}: sag", f"{kind}: mass"), texts, strict=True))
        yield row
    slopes = (f"{slope(sizes, errors):.2f}" for errors in np.transpose(means))
    yield {"h / R": "slope"} | dict(zip((f"{kind}: sag" for kind in KINDS), slopes, strict=True))


def ball_rows() -> lab.Rows:
    for size in (0.4, 1 / 4, 1 / 6, 1 / 8):
        found = {kind: ball_error(size * RADIUS, kind) for kind in KINDS}
        row: dict[str, object] = {"h / R": f"{size:.3f}", "cells": found["fill"][0]}
        for kind, (_, frequency, mass) in found.items():
            row |= {f"{kind}: frequency": percent(frequency), f"{kind}: mass": percent(mass)}
        yield row


TABLES: dict[str, Callable[[], lab.Rows]] = {
    "beam": lambda: of_both(beam_rows),
    "wave": lambda: of_both(wave_rows),
    "round": lambda: bar_rows(round_bar(), ROUND_SAG, (2 / 3, 0.4, 1 / 3, 1 / 4, 1 / 6)),
    "turned": lambda: bar_rows(turned_bar(), SQUARE_SAG, (0.5, 1 / 3, 1 / 4, 1 / 6)),
    "ball": ball_rows,
}


def main() -> None:
    lab.tables(__doc__, TABLES)


if __name__ == "__main__":
    main()
