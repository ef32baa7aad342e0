"""Lattices that are hard for multigrid, on any number of ranks.

The parts of a cycle are dense matrices. Their rows and columns are x, y, z of each node in turn.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from lattices import ORIGIN, block, cages_of
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import bsr_array

from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.geometry.morton import decode_morton
from msmpetsc.lattice.lattice import Lattice, build_lattice
from msmpetsc.lattice.material import CellMaterial
from msmpetsc.scene.body import Material
from msmpetsc.solve.linear.operators import TrueHessian, python_matrix
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid import cycle
from msmpetsc.solve.multigrid.cycle import Multigrid
from msmpetsc.solve.presets import LATTICE_MULTIGRID

CELL, YOUNG, DENSITY = 0.1, 2e5, 1000.0
COMM = MPI.COMM_SELF


def at(cells: np.ndarray, *first: int) -> np.ndarray:
    """Return cells moved on the grid."""
    return cells + np.array(first)


def l_shape() -> np.ndarray:
    cells = block(6, 6, 2)
    return cells[(cells[:, 0] < 2) | (cells[:, 1] < 2)]


def tilted_beam(length: int = 9) -> np.ndarray:
    """Return cells near a line that is parallel to no axis."""
    cells = block(length, length, length)
    along = np.array([3, 2, 1]) / np.sqrt(14)
    away = cells - (cells @ along)[:, None] * along
    return cells[np.linalg.norm(away, axis=1) < 1.5]


def limbs(reach: int = 7) -> np.ndarray:
    """Return a cube with an arm along each axis, one cell thick; no arm begins at an even index."""
    arms = [
        at(block(reach, 1, 1), 4, 2, 1),
        at(block(1, reach, 1), 1, 4, 2),
        at(block(1, 1, reach), 2, 1, 4),
    ]
    return np.concatenate([block(4, 4, 4), *arms])


def box_of_cells(low: list[int], high: list[int], fineness: int) -> np.ndarray:
    return block(*fineness * (np.array(high) - low)) + fineness * np.array(low)


def figure(fineness: int = 1) -> np.ndarray:
    """Return a trunk with a head, legs, outstretched arms and a tail."""
    parts = [
        ([6, 2, 8], [12, 8, 18]), ([7, 3, 18], [11, 7, 22]), ([7, 4, 0], [9, 6, 8]),
        ([10, 4, 0], [12, 6, 8]),
        ([0, 4, 14], [6, 6, 16]), ([12, 4, 15], [18, 6, 16]), ([8, 0, 17], [9, 2, 18]),
    ]  # fmt: skip
    return np.concatenate([box_of_cells(*ends, fineness) for ends in parts])


def comb() -> np.ndarray:
    """Return prongs on a back, with gaps of 1, 2, 3 and 4 cells."""
    prongs = [at(block(7, 2, 2), 0, y, 1) for y in (1, 4, 8, 13, 19)]
    return at(np.concatenate([*prongs, at(block(1, 21, 2), -1, 0, 1)]), 1, 0, 0)


LATTICES: dict[str, np.ndarray] = {
    "block": block(5, 4, 3),
    "block that begins at odd indices": at(block(4, 3, 3), 1, 3, 5),
    "L": l_shape(),
    "tilted beam": tilted_beam(),
    "two bodies": np.concatenate([block(3, 3, 3), at(block(3, 2, 2), 6, 1, 0)]),
    "two bodies in one coarse cell": np.concatenate([block(3, 3, 1), at(block(3, 3, 1), 0, 0, 2)]),
    "thin sheet": block(9, 9, 1),
    "limbs": limbs(),
    "comb": comb(),
    "rod": at(block(14, 1, 1), 1, 1, 1),
    "a cell": block(1, 1, 1),
    "a cell at odd indices": block(1, 1, 1) + 1,
    "many bodies": np.concatenate(
        [at(block(1, 1, 1), 2 * i, 2 * j, 0) for i in range(3) for j in range(3)]
    ),
}


def build(
    comm: MPI.Comm,
    cells: np.ndarray,
    density: float = DENSITY,
    contrast: float = 1.0,
    pins: bool = False,
    poisson: float | None = None,
) -> Lattice:
    """Return the lattice of some cells.

    contrast : factor on the stiffness of cells beyond the middle of x
    pins     : whether the nodes of lowest x are fixed
    poisson  : Poisson's ratio of a solid; None for springs
    """
    middle = cells[:, 0].mean()

    def of_cells(keys: np.ndarray) -> CellMaterial:
        ijk = decode_morton(keys)
        uniform = CellMaterial(
            *(np.full(len(ijk), value) for value in (density, YOUNG, poisson or 0.25))
        )
        return replace(uniform, spring=np.where(ijk[:, 0] > middle, contrast, 1.0) * YOUNG)

    law = {"law": "neo-hookean", "poisson_ratio": poisson} if poisson else {"law": "linear"}
    material = Material(density=density, young_modulus=YOUNG, **law)
    lattice = build_lattice(
        cages_of(cells, CELL, comm), material, of_cells if contrast != 1 else None
    )
    low = comm.allreduce(lattice.nodes[:, 0].min(initial=np.inf), MPI.MIN)
    return lattice.pin(lattice.nodes[:, 0] < low + 0.01 * CELL) if pins else lattice


def heavier(lattice: Lattice, mass: float) -> Lattice:
    """Return the lattice with nodes of this mass [kg]."""
    return replace(lattice, mass=np.full(lattice.owned, mass))


def at_rest(nodes: np.ndarray) -> np.ndarray:
    return nodes.copy()


def twisted(nodes: np.ndarray) -> np.ndarray:
    """Return positions after a twist of 2 rad/m about x and a wave, the same on all ranks."""
    x, y, z = (nodes - ORIGIN).T
    q = nodes.copy()
    q[:, 1] = ORIGIN[1] + np.cos(2 * x) * y - np.sin(2 * x) * z
    q[:, 2] = ORIGIN[2] + np.sin(2 * x) * y + np.cos(2 * x) * z
    return q + 0.02 * np.sin(31 * nodes[:, [1, 2, 0]])


def crushed(nodes: np.ndarray) -> np.ndarray:
    """Return positions pressed to a fifth of the height, where the true Hessian is indefinite."""
    return ORIGIN + (twisted(nodes) - ORIGIN) * [1.0, 1.1, 0.2]


def turned(nodes: np.ndarray) -> np.ndarray:
    """Return positions after a twist of 0.5 rad/m and a stretch: no spring is compressed."""
    x, y, z = (nodes - ORIGIN - 0.1).T
    angle = 0.5 * x
    across = [np.cos(angle) * y - np.sin(angle) * z, np.sin(angle) * y + np.cos(angle) * z]
    return ORIGIN + 1.4 * np.stack([x, *across], axis=1)


SHAPES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "rest": at_rest,
    "twisted": twisted,
    "crushed": crushed,
    "turned": turned,
}


def contact_blocks(lattice: Lattice) -> np.ndarray:
    """Return blocks (owned, 9) [N/m] of a hard push along an oblique normal on every third node."""
    normal = np.array([0.6, 0.0, 0.8])
    touched = lattice.global_numbers[: lattice.owned] % 3 == 0
    return touched[:, None] * 5e4 * np.outer(normal, normal).ravel()


class Applied:
    """A PC as the Python context of another PC."""

    def __init__(self, pc: PETSc.PC):
        self.pc = pc

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.pc.apply(x, y)


class Case:
    """A lattice, and the multigrid cycle for the Hessian at positions q."""

    def __init__(
        self,
        comm: MPI.Comm,
        lattice: Lattice,
        q: np.ndarray,
        time_step: float,
        contact: bool = False,
    ):
        self.comm, self.lattice, self.q, self.time_step = comm, lattice, q, time_step
        self.unknowns = Unknowns(comm, lattice)
        self.elasticity = Elasticity(lattice)
        self.multigrid = Multigrid(self.unknowns, self.elasticity, time_step, "")
        self.blocks = contact_blocks(lattice) if contact else np.empty((0, 9))
        self.multigrid.update(q, self.blocks)
        self.x, self.y = self.multigrid.operator.createVecs()

    @property
    def size(self) -> int:
        return 3 * self.unknowns.total

    def dense(self, act: Callable[[PETSc.Vec, PETSc.Vec], None], every: int = 1) -> np.ndarray:
        """Return the matrix of a linear function, or some of its columns (collective)."""
        first = self.multigrid.operator.getOwnershipRange()[0] // 3
        own = np.zeros((3 * self.unknowns.size, self.size))
        for column in range(0, self.size, every):
            node, c = column // 3 - first, column % 3
            chosen = self.unknowns.columns_to_write(self.x)
            chosen[:] = 0
            if 0 <= node < self.unknowns.size:
                chosen[c, node] = 1
            act(self.x, self.y)
            own[:, column] = self.unknowns.columns(self.y).T.ravel()
        return np.concatenate(self.comm.allgather(own))

    def hessian(self) -> np.ndarray:
        """Return the projected Hessian M + t^2 (Hessian of E and contact), by its products."""
        hessian, t2 = TrueHessian(self.unknowns, self.elasticity, self.time_step), self.time_step**2
        hessian.elastic = self.elasticity.hessian_at(self.q, projected=True)
        matrix = self.dense(lambda x, y: hessian.mult(None, x, y))
        own = (
            self.blocks[self.unknowns.free]
            if len(self.blocks)
            else np.zeros((self.unknowns.size, 9))
        )
        for node, added in enumerate(np.concatenate(self.comm.allgather(own))):
            matrix[3 * node : 3 * node + 3, 3 * node : 3 * node + 3] += t2 * added.reshape(3, 3)
        return matrix

    def cycle(self) -> np.ndarray:
        return self.dense(self.multigrid.pc.apply)

    def interpolation(self, level: int) -> np.ndarray:
        """Return P from the ``level``-th coarse grid to the next finer grid, for 0 to the nodes."""
        rows = self.multigrid.levels[level].interpolation.rows().toarray()
        return np.kron(np.concatenate(self.comm.allgather(rows)), np.eye(3))

    def level(self, level: int) -> np.ndarray:
        """Return the matrix of a coarse level, on every rank."""
        blocks = self.multigrid.coarse_blocks(self.q, self.blocks)[level]
        pattern = self.multigrid.levels[level].pattern
        begin, columns, _ = pattern.getValuesCSR()
        shape = 3 * (len(begin) - 1), 3 * pattern.getSize()[1]
        own = bsr_array((blocks.reshape(-1, 3, 3), columns, begin), shape).toarray()
        return np.concatenate(self.comm.allgather(own))

    def iterations(self, rtol: float, rough: bool) -> int:
        """Return the number of CG iterations with the true Hessian and the cycle, as in newton.

        rtol  : tolerance of the error in the natural norm
        rough : whether the load varies from node to node; otherwise it is a weight
        """
        hessian = TrueHessian(self.unknowns, self.elasticity, self.time_step)
        hessian.linearise(self.q, None)
        operator = python_matrix(self.unknowns, hessian, self.comm)
        ksp = PETSc.KSP().create(self.comm)
        ksp.setType(PETSc.KSP.Type.CG)
        ksp.setNormType(PETSc.KSP.NormType.NATURAL)
        ksp.setOperators(operator)
        ksp.getPC().setType(PETSc.PC.Type.PYTHON)
        ksp.getPC().setPythonContext(Applied(self.multigrid.pc))
        ksp.setTolerances(rtol=rtol, max_it=100)
        owned = self.lattice.nodes[: self.lattice.owned]
        push = (
            np.sin(1000 * (owned - ORIGIN) ** 2)
            if rough
            else self.lattice.mass[:, None] * [0.3, -0.2, -9.81]
        )
        self.unknowns.from_nodes(push, self.x)
        ksp.solve(self.x, self.y)
        assert ksp.reason > 0, ksp.reason
        its = ksp.its
        ksp.destroy()
        operator.destroy()
        return its

    def destroy(self) -> None:
        for owned in (self.x, self.y, self.multigrid, self.unknowns):
            owned.destroy()


@contextmanager
def hierarchy(
    comm: MPI.Comm,
    lattice: Lattice,
    shape: Callable[[np.ndarray], np.ndarray] = at_rest,
    time_step: float = 1 / 60,
    contact: bool = False,
    coarsest: int | None = 800,
) -> Iterator[Case]:
    """Yield the cycle of the presets.

    Its coarsest grid has at most ``coarsest`` nodes, or as many as in a run if that is None.
    """
    database, before = PETSc.Options(), (cycle.COARSEST, cycle.COARSEST_ROOT)
    for name, value in LATTICE_MULTIGRID.items():
        database.setValue(name, value)
    if coarsest is not None:
        cycle.COARSEST, cycle.COARSEST_ROOT = coarsest, coarsest
    case = None
    try:
        case = Case(comm, lattice, shape(lattice.nodes), time_step, contact)
        yield case
    finally:
        cycle.COARSEST, cycle.COARSEST_ROOT = before
        if case:
            case.destroy()
        for name in LATTICE_MULTIGRID:
            database.delValue(name)
