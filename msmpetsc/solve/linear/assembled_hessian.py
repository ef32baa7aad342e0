"""The Hessian of a step as a PETSc matrix, for export and for solvers that need a matrix.

A row of the matrix belongs to a coordinate of a free node: x, y and z of a node in sequence. Rows
and columns of fixed components are zero except for their diagonals. Solvers of this package need no
matrix (solve.linear.operators).
"""

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
from petsc4py import PETSc
from scipy.sparse import csr_array, diags_array, eye_array, kron

from msmpetsc.backend.arrays import Indices, Mask, Rows, to_host
from msmpetsc.contact.surface.surface_contact import SurfaceHessian
from msmpetsc.elasticity.pressure import PressureHessian
from msmpetsc.elasticity.solid import CellHessians
from msmpetsc.elasticity.springs import elastic_hessian
from msmpetsc.lattice.lattice import Springs
from msmpetsc.solve.linear.operators import TrueHessian
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.petsc.library import preallocate_coo, refuse_nonzeros, set_values_coo


class HessianBlocks(NamedTuple):
    """Blocks of this rank; the Hessian is the sum of all ranks' blocks.

    first, second : (k,) global numbers of the nodes of rows and columns, -1 if pinned
    values        : (k, 3, 3) [kg]
    """

    first: Indices
    second: Indices
    values: Rows


def blocks_of(hessian: TrueHessian) -> HessianBlocks:
    """Return the blocks of the Hessian of the last ``linearise`` at free nodes (collective)."""
    whole = [np.concatenate(part) for part in zip(*_parts(hessian), strict=True)]
    is_free = (whole[0] >= 0) & (whole[1] >= 0)
    blocks = HessianBlocks(*(part[is_free] for part in whole))
    unknowns = hessian.unknowns
    node, component = map(to_host, unknowns.rollers)
    fixed = 3 * unknowns.numbers[node] + component
    rows, columns = (
        np.isin(3 * ends[:, None] + np.arange(3), fixed) for ends in (blocks.first, blocks.second)
    )
    is_diagonal = (blocks.first == blocks.second)[:, None, None] & np.eye(3, dtype=bool)
    blocks.values[(rows[:, :, None] | columns[:, None, :]) & ~is_diagonal] = 0
    return blocks


def assembled(unknowns: Unknowns, blocks: HessianBlocks) -> PETSc.Mat:
    """Return the Hessian as an AIJ matrix of block size 3 in CPU memory (collective).

    Raises InputError if the nonzeros exceed PETSc's integers.
    """
    refuse_nonzeros(unknowns.comm, blocks.values.size)
    row, column = np.arange(3)[:, None], np.arange(3)
    rows, columns = np.broadcast_arrays(
        3 * blocks.first[:, None, None] + row, 3 * blocks.second[:, None, None] + column
    )
    matrix = PETSc.Mat().create(comm=unknowns.comm)
    matrix.setSizes(2 * ((3 * unknowns.size, 3 * unknowns.total),), bsize=3)
    matrix.setType(PETSc.Mat.Type.AIJ)
    preallocate_coo(matrix, rows.ravel(), columns.ravel())
    set_values_coo(matrix, blocks.values.ravel())
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return matrix


def _parts(hessian: TrueHessian) -> Iterator[HessianBlocks]:
    """Yield the blocks of inertia, springs, cells, pressure and contact.

    Nodes of pressure and of surface contact may belong to other ranks. Fixed components are
    therefore left out of their blocks here.
    """
    unknowns, t2, numbers = hessian.unknowns, hessian.t2, hessian.unknowns.numbers
    own = numbers[to_host(unknowns.free)]
    inertia = to_host(unknowns.inertia)[to_host(unknowns.free)]
    yield HessianBlocks(own, own, inertia[:, None, None] * np.eye(3))
    if hessian.elasticity.springs:
        yield from _of_springs(hessian)
    for part in hessian.elastic.parts if hessian.elastic else ():
        if isinstance(part, CellHessians):
            yield _of_cells(part, numbers, t2)
        if isinstance(part, PressureHessian):
            yield from _of_pressure(part, unknowns, t2)
    for rows, blocks in hessian.contact.parts if hessian.contact else ():
        at = own[to_host(rows)]
        yield HessianBlocks(at, at, to_host(blocks))
    if hessian.surface:
        yield _of_surface(hessian.surface, unknowns, t2)


def _of_springs(hessian: TrueHessian) -> Iterator[HessianBlocks]:
    """Yield the blocks t^2 (c I + e e^T) of this rank's springs."""
    lattice = hessian.unknowns.lattice
    given = lattice.springs, lattice.rest_length, lattice.stiffness
    springs = Springs(*(to_host(part)[: lattice.springs_owned] for part in given))
    q, projected = hessian.at
    coefficients = np.empty((len(springs.ends), 4))
    elastic_hessian(to_host(q), springs, projected, coefficients)
    c, e = coefficients[:, :1, None], coefficients[:, 1:]
    blocks = hessian.t2 * (c * np.eye(3) + e[:, :, None] * e[:, None, :])
    a, b = hessian.unknowns.numbers[springs.ends].T
    for first, second, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
        yield HessianBlocks(first, second, sign * blocks)


def _of_cells(part: CellHessians, numbers: Indices, t2: float) -> HessianBlocks:
    """Return the blocks of the cells that this rank owns, summed over the cells.

    Products with unit vectors give the matrices of all cells at once, because here each cell is
    copied with eight nodes of its own.
    """
    blocks, owned = part.blocks, part.blocks.owned
    nodes = to_host(blocks.nodes)[:owned]
    corners = numbers[nodes.reshape(-1, 8)]
    span = int(corners.max(initial=0)) + 1
    first, second = corners[:, :, None], corners[:, None, :]
    pairs = np.where((first >= 0) & (second >= 0), first * span + second, -1)
    distinct, place = np.unique(pairs, return_inverse=True)
    place = place.reshape(-1, 8, 8)
    alone = CellHessians(
        blocks._replace(
            nodes=np.arange(nodes.size, dtype=nodes.dtype).reshape(nodes.shape),
            which=to_host(blocks.which)[:owned],
            constants=to_host(blocks.constants),
            around=np.empty((8, 0), np.int64),
        ),
        to_host(part.state)[:owned],
    )
    sums, v = np.zeros((len(distinct), 3, 3)), np.zeros((corners.size, 3))
    for corner, component in product(range(8), range(3)):
        v[:] = 0
        v[corner::8, component] = t2
        forces = np.zeros_like(v)
        alone(v, forces)
        np.add.at(sums[:, :, component], place[:, :, corner], forces.reshape(-1, 8, 3))
    return HessianBlocks(distinct // span, distinct % span, sums)


def _of_surface(surface: SurfaceHessian, unknowns: Unknowns, t2: float) -> HessianBlocks:
    """Return the blocks t^2 W^T H_c W in this rank's rows (collective)."""
    own = unknowns.numbers[unknowns.free]
    weights = _by_component(
        surface.weights[:, unknowns.free], unknowns.lattice.fixed[unknowns.free]
    )
    rows = (3 * own[:, None] + np.arange(3)).ravel()
    placed = csr_array(
        (weights.data, rows[weights.indices], weights.indptr),
        shape=(weights.shape[0], 3 * unknowns.total),
    )
    # The order of the ranks makes the sum reproducible
    whole = sum(unknowns.comm.allgather(placed))
    first, second, values = _joined(weights, csr_array(surface.points @ whole))
    return HessianBlocks(own[first], second, t2 * values)


def _of_pressure(part: PressureHessian, unknowns: Unknowns, t2: float) -> Iterator[HessianBlocks]:
    """Yield the blocks t^2 W^T H_p W of this rank's triangles under pressure (collective)."""
    for surface, triangles in part.triangles():
        points = surface.points
        numbers, fixed = (
            points.to_owner.answer(rows[points.asked])
            for rows in (unknowns.numbers, unknowns.lattice.fixed)
        )
        # Points are ordered by corner, then by triangle
        ends = np.arange(9 * len(triangles)).reshape(3, -1, 3).swapaxes(0, 1).reshape(-1, 9)
        places = np.broadcast_arrays(ends[:, :, None], ends[:, None, :])
        matrix = csr_array((triangles.ravel(), [of.ravel() for of in places]), (ends.size,) * 2)
        weights = _by_component(points.weights, fixed)
        first, second, values = _joined(weights, csr_array(matrix @ weights))
        yield HessianBlocks(numbers[first], numbers[second], t2 * values)


def _by_component(weights: csr_array, fixed: Mask) -> csr_array:
    """Return weights (v, n) of nodes as (3v, 3n) of components; 0 for fixed components (n, 3)."""
    return csr_array(kron(weights, eye_array(3)) @ diags_array(np.where(fixed, 0.0, 1.0).ravel()))


def _joined(left: csr_array, right: csr_array) -> HessianBlocks:
    """Return the blocks of left^T right; ``first`` and ``second`` are columns of left and right."""
    blocks = csr_array(left.T @ right).tobsr((3, 3))
    first = np.repeat(np.arange(left.shape[1] // 3), np.diff(blocks.indptr))
    return HessianBlocks(first, blocks.indices.astype(np.int64), blocks.data)
