#!/usr/bin/env python3
"""Checks the calibrated lattice against elasticity and prints Markdown tables. Needs scikit-fem.

Static problems and eigenfrequencies use the Hessian of E at rest, assembled here on its own from the list of
springs; the wave and the free flight use the product's own steps. All errors are relative.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence

from clone import parser

import numpy as np
import skfem
import trimesh
from mpi4py import MPI
from scipy.linalg import eigh, expm
from scipy.optimize import brentq
from scipy.sparse import coo_array, csc_array, diags
from scipy.sparse.linalg import LinearOperator, eigsh, splu
from scipy.spatial.transform import Rotation
from skfem.models.elasticity import lame_parameters, linear_elasticity

from msmpetsc.geometry.cages import Body, fill
from msmpetsc.geometry.surface import Surface, examine
from msmpetsc.model.lattice import Lattice, build_lattice
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.presets import find_preset

E, NU, DENSITY, GRAVITY = 1e6, 1 / 4, 1000.0, 9.81  # [Pa], [-], [kg/m^3], [m/s^2]
C11, C12, C44 = 6 / 5 * E, 2 / 5 * E, 2 / 5 * E  # [Pa]
WIDTH, BEAM = 0.1, 10  # of the beam [m], and its length in widths
ACROSS = (2, 4, 6, 8)  # cells across the beam
COMM = MPI.COMM_SELF


# ---- the lattice of a box, its Hessian at rest


def box(cells: tuple[int, int, int], cell_size: float) -> Lattice:
    """The calibrated lattice of a box filled with exactly these cells, its low corner at the origin."""
    mesh = trimesh.creation.box(np.ones(3))
    surface = Surface((mesh.vertices + 0.5) * cells * cell_size, np.array(mesh.faces))
    bounds = np.array([surface.points.min(axis=0), surface.points.max(axis=0)])
    return build_lattice(fill([Body(COMM, surface, examine(surface), bounds)], cell_size), DENSITY, young_modulus=E)


def beam(across: int) -> Lattice:
    """A square beam along x, WIDTH wide and BEAM widths long, so many cells across."""
    return box((BEAM * across, across, across), WIDTH / across)


def hessian(lattice: Lattice, share: np.ndarray | float = 1.0) -> csc_array:
    """Hessian of E at rest (3n, 3n) [N/m]: a block k d d^T a spring, d its direction; ``share`` (s,) of each."""
    a, b = lattice.springs.T
    d = (lattice.nodes[a] - lattice.nodes[b]) / lattice.rest_length[:, None]
    along = np.concatenate([d, -d], axis=1)
    blocks = (share * lattice.stiffness)[:, None, None] * along[:, :, None] * along[:, None, :]
    rows = np.concatenate([3 * a[:, None] + np.arange(3), 3 * b[:, None] + np.arange(3)], axis=1)
    places = [index.ravel() for index in np.broadcast_arrays(rows[:, :, None], rows[:, None, :])]
    return coo_array((blocks.ravel(), places), shape=2 * (lattice.nodes.size,)).tocsc()


def factorise(K: csc_array) -> Callable[[np.ndarray], np.ndarray]:
    """f -> K^(-1) f, K symmetric positive definite."""
    return splu(csc_array(K), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve


# ---- uniform strain


def inner_nodes(lattice: Lattice) -> np.ndarray:
    """(n,) bool: nodes within eight cells."""
    return np.bincount(lattice.springs.ravel()) == 26


def elastic_constant(lattice: Lattice, G: np.ndarray, other: np.ndarray, inner: bool = False) -> float:
    """u^T H v / volume [Pa] of the linear displacements u = G x, v = other x, their gradients (3, 3).

    inner : of the inner nodes alone, each with half of its springs and a cell's volume
    """
    share, volume = 1.0, lattice.mass.sum() / DENSITY
    if inner:
        nodes = inner_nodes(lattice)
        share, volume = nodes[lattice.springs].sum(axis=1) / 2, nodes.sum() * lattice.cell_size**3
    u, v = ((lattice.nodes @ gradient.T).ravel() for gradient in (G, other))
    return u @ (hessian(lattice, share) @ v) / volume


def uniform_strains() -> Iterator[tuple[str, np.ndarray, np.ndarray, float]]:
    """Name, two displacement gradients, and what u^T H v / volume is in an isotropic solid of nu = 1/4 [Pa]."""
    x, y, z = np.eye(3)
    yield "C11: stretch along an edge", np.outer(x, x), np.outer(x, x), C11
    yield "C12: stretch along one edge against another", np.outer(x, x), np.outer(y, y), C12
    yield "C44: shear", np.outer(x, y), np.outer(x, y), C44
    turned = {"(1,1,0)": (x + y, z), "(1,1,1)": (x + y + z, x - y), "(3,2,6)": (3 * x + 2 * y + 6 * z, 2 * x - 3 * y)}
    for name, pair in turned.items():
        d, across = (direction / np.linalg.norm(direction) for direction in pair)
        yield f"C11 along {name}", np.outer(d, d), np.outer(d, d), C11
        yield f"C12 along {name}", np.outer(d, d), np.outer(across, across), C12
        yield f"C44 along {name}", np.outer(d, across), np.outer(d, across), C44


# ---- a clamped beam: Timoshenko's, the lattice, and scikit-fem's


def beam_section(across: float = np.inf) -> tuple[float, float, float, float]:
    """E I [N m^2], kappa G A [N], rho A [kg/m], rho I [kg m] of the beam; kappa by Cowper (1966).

    across : for the lattice so many cells across. A cell cannot curve between its corners: their displacements
             u_x = c x z, u_y = -nu c y z stretch edges and face diagonals (k1 : k2 = 40 : 16) by energies that add
             up to 103/560 E c^2 h^2 / 2 a volume where bending has 1/12, so E I grows by 1 + 169/140 (h/b)^2.
             And its masses sit at corners: rho I grows by 1 + 2 (h/b)^2.
    """
    A, second_moment, ratio = WIDTH**2, WIDTH**4 / 12, 1 / across**2
    kappa, G = 10 * (1 + NU) / (12 + 11 * NU), E / (2 * (1 + NU))
    return (
        E * second_moment * (1 + 169 / 140 * ratio),
        kappa * G * A,
        DENSITY * A,
        DENSITY * second_moment * (1 + 2 * ratio),
    )


def timoshenko_sag(across: float = np.inf) -> float:
    """Tip deflection [m] of the beam clamped at one end, under its weight: w L^4 / (8 E I) + w L^2 / (2 kappa G A)."""
    EI, kGA, line_mass, _ = beam_section(across)
    w, L = line_mass * GRAVITY, BEAM * WIDTH
    return w * L**4 / (8 * EI) + w * L**2 / (2 * kGA)


def timoshenko_frequency(across: float = np.inf) -> float:
    """First bending frequency [Hz] of the beam clamped at one end.

    (w, phi, M, V)' = B (w, phi, M, V) along x; w = phi = 0 at the clamp, and M = V = 0 at the free end: the block
    of exp(B L) that takes M, V there from those at the clamp is singular.
    """
    EI, kGA, line_mass, line_inertia = beam_section(across)

    def end(omega: float) -> float:
        B = np.zeros((4, 4))
        B[0, 1], B[0, 3], B[1, 2] = 1, 1 / kGA, 1 / EI
        B[2, 1], B[2, 3], B[3, 0] = -line_inertia * omega**2, -1, -line_mass * omega**2
        return np.linalg.det(expm(B * BEAM * WIDTH)[2:, 2:])

    slender = 1.8751**2 * np.sqrt(EI / line_mass) / (BEAM * WIDTH) ** 2  # Euler-Bernoulli's [rad/s], a little higher
    return brentq(end, 0.5 * slender, 1.1 * slender, xtol=1e-12 * slender) / (2 * np.pi)


def lattice_beam(across: int) -> tuple[float, float]:
    """Tip deflection [m] under its weight and first bending frequency [Hz] of the lattice, one end face held.

    Both linear, as Timoshenko's: how large the deflection is does not matter.
    """
    lattice = beam(across)
    K, mass, x = hessian(lattice), np.repeat(lattice.mass, 3), np.repeat(lattice.nodes[:, 0], 3)
    vertical, free = np.tile([False, False, True], len(lattice.nodes)), ~np.isclose(x, 0)
    K, M, u = K[free][:, free], diags(mass[free]), np.zeros(len(free))
    inverse = factorise(K)
    u[free] = inverse(-(GRAVITY * mass * vertical)[free])
    # bending along y and along z are one double eigenvalue; a start that is given keeps the figures the same
    modes = {"OPinv": LinearOperator(K.shape, inverse), "v0": np.ones(K.shape[0]), "return_eigenvectors": False}
    squares = eigsh(K, k=2, M=M, sigma=0, **modes)
    return -u[vertical & np.isclose(x, BEAM * WIDTH)].mean(), np.sqrt(squares.min()) / (2 * np.pi)


def fem_sag(across: int, order: int = 1) -> float:
    """Tip deflection [m] of the same beam of scikit-fem's hexahedra on the same grid: trilinear, or of order 2."""
    sides = [np.linspace(0, side * WIDTH, side * across + 1) for side in (BEAM, 1, 1)]
    element = skfem.ElementVector({1: skfem.ElementHex1, 2: skfem.ElementHex2}[order]())
    basis = skfem.Basis(skfem.MeshHex.init_tensor(*sides), element, intorder=2 * order + 1)  # exact for cubes
    K = linear_elasticity(*lame_parameters(E, NU)).assemble(basis).tocsc()
    f = skfem.LinearForm(lambda v, _: -DENSITY * GRAVITY * v[2]).assemble(basis)
    free = basis.complement_dofs(basis.get_dofs(lambda x: np.isclose(x[0], 0)))
    u = np.zeros(basis.N)
    u[free] = factorise(K[free][:, free])(f[free])
    return -u[basis.nodal_dofs[2, np.isclose(basis.mesh.p[0], BEAM * WIDTH)]].mean()


# ---- steps of the product


def steps(
    lattice: Lattice,
    t: float,
    q: np.ndarray,
    before: np.ndarray,
    loads: Iterable[np.ndarray],
    error: float,
    preset: str = "newton",
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """q_(n+1) and q_n, one pair for each of the loads (n, 3) [N]; from q_n and q_(n-1)."""
    stepper = Stepper(COMM, lattice, t, find_preset(preset), error=error)
    try:
        for load in loads:
            q, before = stepper.step(StepProblem(q, 2 * q - before, load)).position, q
            yield q, before
    finally:
        stepper.destroy()


# ---- a compression wave in a bar


BAR, STATIONS = 120, (30, 80)  # its length and where it is watched [cells]; two cells wide, WIDTH
CELL = WIDTH / 2
SPEED = np.sqrt(E / DENSITY)  # of long waves in a thin bar [m/s]
PULSE = 5 * CELL / SPEED  # standard deviation of the blow [s]
STRAIN = 1e-4  # changes the speed by 0.17 of it, measured


def struck_bar(courant: float) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) [s] and mean axial velocities (T, 2) [m/s] at the two stations of a bar struck at one end.

    The blow is a Gaussian in time. In a time step the wave goes ``courant`` cells far; the last time lies before
    the echo from the far end.
    """
    lattice, t = box((BAR, 2, 2), CELL), courant * CELL / SPEED
    section = np.rint(lattice.nodes[:, 0] / CELL)
    force = np.zeros_like(lattice.nodes)
    end = section == 0
    force[end, 0] = STRAIN * E * WIDTH**2 * lattice.mass[end] / lattice.mass[end].sum()
    times = t * np.arange(1, round((STATIONS[1] + 60) / courant))
    blows = (np.exp(-0.5 * (time / PULSE - 5) ** 2) * force for time in times)
    motion = steps(lattice, t, lattice.nodes, lattice.nodes, blows, error=1e-5)
    return times, np.array([[(q - p)[section == s, 0].mean() / t for s in STATIONS] for q, p in motion])


def wave_speeds(times: np.ndarray, v: np.ndarray) -> tuple[float, float, float]:
    """Errors of the speeds of a pulse's centre and of its peak, and what is left of its height."""
    centre = times @ v / v.sum(axis=0)
    peak = []
    for column in v.T:  # the top of a parabola through the three highest values
        at = column.argmax()
        low, top, high = column[at - 1 : at + 2]
        peak.append(times[at] + (times[1] - times[0]) * (low - high) / (low - 2 * top + high) / 2)
    of_centre, of_peak = np.diff(STATIONS) * CELL / np.diff([centre, peak])[:, 0] / SPEED - 1
    return of_centre, of_peak, v[:, 1].max() / v[:, 0].max()


def dispersion(across: int = 2, phase: float = 0.05) -> float:
    """beta [m^2] in omega = c k (1 - beta k^2) of the compression wave of a lattice bar, WIDTH wide.

    From the Hessian's blocks between one section and its neighbours: K(k) = sum_j K_j exp(i j k h); ``phase`` k h.
    """
    h = WIDTH / across
    lattice = box((4, across, across), h)
    order = np.lexsort(lattice.nodes.T[::-1])  # section by section
    unknowns = (3 * order[:, None] + np.arange(3)).reshape(5, -1)
    rows = hessian(lattice)[unknowns[2]]
    K = sum(rows[:, unknowns[2 + j]].toarray() * np.exp(1j * j * phase) for j in (-1, 0, 1))
    mass = np.repeat(lattice.mass, 3)[unknowns[2]]
    squares, modes = eigh(K, np.diag(mass))
    axial = np.abs((mass.reshape(-1, 3) * [1, 0, 0]).ravel() @ modes).argmax()
    return (1 - np.sqrt(squares[axial]) * h / (SPEED * phase)) * (h / phase) ** 2


def predicted_peak(courant: float) -> tuple[float, float, float]:
    """What of the peak's error the bar itself, its cells and implicit Euler cause, by linear theory.

    The bar has beta = nu^2 r^2 / 2 by its motion across (Rayleigh), r^2 = b^2 / 6 its polar radius squared; the cells
    add what the lattice has more. Implicit Euler puts (1 - exp(-i omega t)) / t in the place of i omega. So on its way
    x the pulse's third cumulant in time grows by (t^2 - 6 beta / c^2) x / c and the second by t x / c; the first, its
    centre, takes x / c whatever t and beta are. The peak of a Gaussian that has become a little skew leads its
    centre by half the third over the second.
    """
    t = courant * CELL / SPEED
    bar = NU**2 / 2 * WIDTH**2 / 6
    thirds = np.array([-6 * bar, -6 * (dispersion() - bar), (SPEED * t) ** 2]) / SPEED**2
    travel = np.array(STATIONS) * CELL / SPEED
    first, second = (thirds * x / (2 * (PULSE**2 + t * x)) for x in travel)
    return tuple((second - first) / np.diff(travel))


# ---- free flight


SHAKE = 0.1  # of the runs whose momentum is shown [m/s]


def free_flight(
    time_step: float, shake: float = 0.0, preset: str = "newton", error: float = 1e-10
) -> tuple[float, float, float]:
    """Drift of momentum and loss of angular momentum in a second, and the loss of a rigid body (``rigid_loss``).

    A block of 4 x 3 x 2 cells of 0.1 m thrown at 1 m/s, spinning at 2 rad/s about its shortest side.

    shake : standard deviation of random node velocities [m/s]. A body that stays symmetric about its middle keeps
            its momentum whatever the solver does, a shaken one need not
    """
    lattice = box((4, 3, 2), 0.1)
    mass, spin, throw, count = lattice.mass, 2.0, np.array([0.6, -0.48, 0.64]), round(1 / time_step)
    middle, turn = mass @ lattice.nodes / mass.sum(), Rotation.from_rotvec([0, 0, -spin * time_step])
    velocity = throw + shake * np.random.default_rng(0).standard_normal(lattice.nodes.shape)
    q, before = lattice.nodes, turn.apply(lattice.nodes - middle) + middle - velocity * time_step

    def momenta(q: np.ndarray, before: np.ndarray) -> tuple[np.ndarray, float]:
        each = mass[:, None] * (q - before) / time_step
        return each.sum(axis=0), np.cross(q - mass @ q / mass.sum(), each)[:, 2].sum()

    start, spin_start = momenta(q, before)
    *_, last = steps(lattice, time_step, q, before, count * [np.zeros_like(q)], error, preset)
    end, spin_end = momenta(*last)
    drift = float(np.linalg.norm(end - start) / np.linalg.norm(start))
    return drift, 1 - spin_end / spin_start, rigid_loss(spin * time_step, count)


def rigid_loss(angle: float, steps: int) -> float:
    """Angular momentum that implicit Euler takes from a rigid body turning by ``angle`` a step, as a share.

    Central forces make no torque, so sum_i x_(n+1) x M (x_(n+1) - 2 x_n + x_(n-1)) = 0: with a_n the n-th turn
    sin(a_n + a_(n-1)) = 2 sin a_n. The momentum goes as sin a_n; da/dn = -a^3 for small ones.
    """
    last = angle
    for _ in range(steps):
        last = np.arctan2(np.sin(last), 2 - np.cos(last))
    return 1 - np.sin(last) / np.sin(angle)


# ---- the tables


def table(columns: list[str], rows: Iterable[Iterable]) -> None:
    print("\n|", " | ".join(columns), "|")
    print("|---" * len(columns) + "|")
    for row in rows:
        print("|", " | ".join(f"{x:.3g}" if isinstance(x, float) else str(x) for x in row), "|")


def percent(share: float, digits: int = 2) -> str:
    return f"{100 * share:+.{digits}f}%"


def slope(sizes: Sequence[float] | np.ndarray, errors: Sequence[float] | np.ndarray) -> float:
    """Return the slope of a line fitted to log |error| over log size."""
    return np.polyfit(np.log(sizes), np.log(np.abs(errors)), 1)[0]


def strain_table() -> None:
    lattice = box((5, 6, 7), 0.1)
    rows = [
        (name, *(f"{elastic_constant(lattice, G, other, inner) / exact - 1:.0e}" for inner in (True, False)))
        for name, G, other, exact in uniform_strains()
    ]
    table(["uniform strain", "inner nodes", "whole block"], rows)


def beam_table() -> None:
    sag, frequency = timoshenko_sag(), timoshenko_frequency()
    rows, errors = [], []
    for across in ACROSS:
        lattice_sag, lattice_frequency = lattice_beam(across)
        found = np.array([lattice_sag / sag, fem_sag(across) / sag, lattice_frequency / frequency])
        expected = np.array([timoshenko_sag(across) / sag, timoshenko_frequency(across) / frequency])
        errors.append(found - 1)
        rows.append((across, *map(percent, (found[0] - 1, expected[0] - 1, *(found[1:] - 1), expected[1] - 1))))
    slopes = [f"{slope(1 / np.array(ACROSS), error):.2f}" for error in np.transpose(errors)]
    rows.append(("slope", slopes[0], "", slopes[1], slopes[2], ""))
    columns = ["cells across", "deflection", "expected", "scikit-fem, trilinear", "frequency", "expected"]
    table(columns, rows)
    solid = fem_sag(3, order=2) / sag - 1
    print(f"\nDeflection of the solid, by scikit-fem's quadratic hexahedra, three across: {percent(solid)}.")


def wave_table() -> None:
    rows = []
    for courant in (1 / 4, 1 / 8, 1 / 16):
        centre, peak, height = wave_speeds(*struck_bar(courant))
        parts = predicted_peak(courant)
        rows.append((courant, percent(centre, 4), *map(percent, (peak, sum(parts), *parts)), f"{height:.2f}"))
    table(["c t / h", "centre", "peak", "expected", "bar", "cells", "implicit Euler", "height left"], rows)


def flight_table() -> None:
    sizes = np.array([1 / 50, 1 / 100, 1 / 200, 1 / 400])
    found = np.array([free_flight(t) for t in sizes])
    solvers = {"newton": 1e-10, "anderson": 1e-3}
    drifts = [[free_flight(t, SHAKE, *solver)[0] for solver in solvers.items()] for t in sizes]
    rows = [
        (f"1/{1 / t:.0f}", *(f"{drift:.0e}" for drift in pair), percent(-loss, 3), percent(-rigid, 3))
        for t, pair, (_, loss, rigid) in zip(sizes, drifts, found, strict=True)
    ]
    rows.append(("slope", "", "", f"{slope(sizes, found[:, 1]):.2f}", f"{slope(sizes, found[:, 2]):.2f}"))
    momenta = [f"momentum, `{preset}` to {error:.0e}" for preset, error in solvers.items()]
    table(["t [s]", *momenta, "angular momentum in 1 s", "rigid body under implicit Euler"], rows)


def main() -> None:
    parser(__doc__).parse_args()
    for show in (strain_table, beam_table, wave_table, flight_table):
        show()


if __name__ == "__main__":
    main()
