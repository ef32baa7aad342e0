"""Lattices of a few cells, a mass on a spring, and a swinging beam."""

from itertools import product

import numpy as np
from mpi4py import MPI

from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.geometry.cages import Cages
from msmpetsc.geometry.copies import Copies
from msmpetsc.geometry.grid import BodyGrids, Grid
from msmpetsc.geometry.morton import encode_morton
from msmpetsc.geometry.partition import SortedKeys
from msmpetsc.lattice.lattice import Lattice, build_lattice
from msmpetsc.scene.body import Material
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.presets import find_preset

E, H, DENSITY = 3e4, 0.2, 800.0
T = 1 / 60
GRAVITY = np.array([0, 0, -9.81])
COMM = MPI.COMM_SELF
NO_COPIES = Copies(np.empty(0, np.int64), np.empty((0, 8), np.int64))
ORIGIN = np.array([1.0, -2.0, 3.0])


def cages_of(cells: np.ndarray, cell_size: float = H, comm: MPI.Comm = COMM) -> Cages:
    """Cages made of exactly these cells (c, 3)."""
    grid = Grid(ORIGIN, cell_size, cells.max(axis=0) + 1)
    table = SortedKeys(comm, encode_morton(cells)[comm.rank :: comm.size])
    count = len(table.keys)
    return Cages(
        BodyGrids((grid,)), table, np.ones(count, np.uint8), np.ones((count, 2, 2, 2)),
        np.full((count, 3), 1 / 12), is_weighted=False, copies=NO_COPIES, parts=(None,),
    )  # fmt: skip


def block(*sides: int) -> np.ndarray:
    return np.array(list(product(*(range(n) for n in sides))))


def beam() -> Lattice:
    """Return a lattice of 8 x 2 x 2 cells of 0.1 m, clamped at its low end."""
    lattice = build_lattice(
        cages_of(block(8, 2, 2), 0.1), Material(density=1000, young_modulus=2e5, law="linear")
    )
    return lattice.pin(lattice.nodes[:, 0] < 1.01)


def weight(lattice: Lattice) -> np.ndarray:
    return lattice.mass[:, None] * GRAVITY


def swing(preset: str, steps: int, lattice: Lattice | None = None, **settings) -> list:
    """Return the steps of a beam released under its weight."""
    lattice = lattice or beam()
    stepper = Stepper(COMM, lattice, T, find_preset(preset), **settings)
    stepper.set_up()
    q, before, results = lattice.nodes.copy(), lattice.nodes.copy(), []
    try:
        for _ in range(steps):
            result = stepper.step(StepProblem(q, 2 * q - before, weight(lattice)))
            q, before = result.position, q
            results.append(result)
    finally:
        stepper.destroy()
    return results


def dense_hessian(elasticity: Elasticity, q: np.ndarray, projected: bool = False) -> np.ndarray:
    """Return the Hessian (3n, 3n) of an elastic energy at q (n, 3), by its products."""
    hessian, columns = elasticity.hessian_at(q, projected), []
    for unit in np.eye(q.size):
        columns.append(np.zeros_like(q))
        hessian.add_product(unit.reshape(q.shape), columns[-1])
    return np.array(columns).reshape(q.size, q.size)


def one_spring(m: float, k: float, r: float) -> Lattice:
    """Return a mass on a spring along z, whose other end is pinned."""
    return _in_line(r, m, k, r, [True, False])


def chain(m: float, k: float, r: float) -> Lattice:
    """Return four masses 1 apart, joined by springs of rest length r; both ends are pinned."""
    return _in_line(1.0, m, k, r, [True, False, False, True])


def _in_line(apart: float, m: float, k: float, r: float, pinned: list[bool]) -> Lattice:
    """Return masses along z, each joined to the next."""
    numbers = np.arange(len(pinned))
    count = len(pinned) - 1
    return Lattice(
        table=SortedKeys(COMM, numbers),
        cell_size=apart,
        nodes=numbers[:, None] * np.array([0.0, 0, apart]),
        ghosts=np.empty(0, np.int64),
        mass=np.full(len(pinned), m),
        cells=np.empty((0, 8), np.int64),
        cell_kind=np.empty(0, np.uint8),
        springs=np.column_stack([numbers[:-1], numbers[1:]]),
        springs_owned=count,
        rest_length=np.full(count, r),
        stiffness=np.full(count, k),
        fixed=np.repeat(np.array(pinned)[:, None], 3, axis=1),
    )
