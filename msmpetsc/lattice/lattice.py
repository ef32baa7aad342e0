"""The lattice of a body: cell corners become masses, pairs of corners within a cell become springs.

Each rank holds its owned nodes, every spring of an owned node, and the ghost nodes at their other
ends. Global node numbers follow Morton order, so they do not depend on the number of ranks.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array, Floats, Indices, Mask, Positions, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.comm import SortedKeys, starts
from msmpetsc.geometry.cages import Cages
from msmpetsc.geometry.morton import decode_morton, encode_morton
from msmpetsc.lattice.cell_moments import WHOLE, bounding_laplacians, forms_of, laplacians
from msmpetsc.lattice.cut_cells import CORNERS as CORNERS
from msmpetsc.lattice.cut_cells import shares_of_mass, shares_of_pairs
from msmpetsc.lattice.material import (
    CellMaterial,
    MaterialOfCells,
    calibrated_stiffness,
    edge_stiffness,
    lame_constants,
)
from msmpetsc.scene.body import Material

# direction (8, 8) from corner a to b [-]; an index into the 3 x 3 x 3 nodes around a
DIRECTION = (CORNERS[None, :, :] - CORNERS[:, None, :] + 1) @ np.array([9, 3, 1])
# kind (27,) of the spring in each direction [-]: its squared length in cells
KIND = ((np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), axis=1) - 1) ** 2).sum(axis=1)
NO_CELLS = np.empty((0, 8), np.int64)


class SolidCells(NamedTuple):
    """Constants of a solid for each of a lattice's ``local_cells`` (elasticity.neo_hookean).

    forms  : (d, 13) strain forms of the cells (lattice.cell_moments)
    volume : (d,) volume inside the surface [m^3]
    shear, lame : (d,) mu and lambda [Pa]
    """

    forms: Rows
    volume: Floats
    shear: Floats
    lame: Floats


@dataclass(frozen=True)
class Lattice:
    """This rank's part of a lattice. Local numbers begin with the ``owned`` nodes; ghosts follow.

    table       : global node numbers by grid key; ``table.first`` is that of the first owned node
    nodes       : (l, 3) rest positions [m]
    ghosts      : (l - owned,) global numbers of the ghost nodes
    mass        : (owned,) [kg]
    cells       : (c, 8) global corner nodes of the cells that this rank owns
    cell_kind   : (c,) BOUNDARY or INTERIOR of geometry.cages
    springs     : (s, 2) local ends. This rank owns the first ``springs_owned``, whose first end has
                  the lower number. The rank of the lower-numbered end owns each further spring.
    rest_length : (s,) distance of the ends at rest [m]
    stiffness   : (s,) [N/m]; a solid has zero-length springs whose L bounds its Hessian at rest
    pinned      : (l,) bool, nodes that do not move
    local_cells : (d, 8) local corner nodes of cells. The first ``cells_owned`` are the cells whose
                  first corner this rank owns. For a solid all cells around owned nodes follow.
    cell_stiffness : (d,) stiffness of an edge inside a body of the cell's material [N/m]
    cell_share  : (c,) fraction of each of ``cells`` that lies inside the surface [-]
    first_of_body : (b,) global number of each body's first node; a body's numbers are consecutive
    solid       : constants of a neo-Hookean solid; None if the law is springs
    viscous     : beta / tau [-], viscosity of a step over the stiffness (elasticity.viscosity)
    """

    table: SortedKeys
    cell_size: float
    nodes: Positions
    ghosts: Indices
    mass: Floats
    cells: Indices
    cell_kind: Array
    springs: Indices
    springs_owned: int
    rest_length: Floats
    stiffness: Floats
    pinned: Mask
    local_cells: Indices = field(default_factory=lambda: NO_CELLS)
    cells_owned: int = 0
    cell_stiffness: Floats = field(default_factory=lambda: np.empty(0))
    cell_share: Floats = field(default_factory=lambda: np.empty(0))
    first_of_body: Indices = field(default_factory=lambda: np.zeros(1, np.int64))
    solid: SolidCells | None = None
    viscous: float = 0.0

    @property
    def owned(self) -> int:
        """Number of nodes that this rank owns."""
        return len(self.mass)

    @property
    def global_numbers(self) -> Indices:
        """Global number (l,) of each local node."""
        return np.concatenate([self.table.first + np.arange(self.owned), self.ghosts])

    def body_of(self, numbers: int | Indices) -> Indices:
        """Return the number of the body that each node belongs to, from global node numbers."""
        return np.searchsorted(self.first_of_body, numbers, side="right") - 1

    @property
    def body(self) -> Indices:
        """Number (l,) of the body that each local node belongs to."""
        return self.body_of(self.global_numbers)

    def stiffest(self, comm: MPI.Comm) -> float:
        """Return the greatest stiffness [N/m] of a spring, or of a solid's cell (collective)."""
        stiffness = self.stiffness if self.solid is None else self.cell_stiffness
        return float(comm.allreduce(stiffness.max(initial=0), MPI.MAX))

    def pin(self, where: Mask) -> "Lattice":
        """Return this lattice with the nodes ``where`` (l,) bool pinned, too."""
        return replace(self, pinned=self.pinned | where)


def build_lattice(
    cages: Cages,
    material: Material,
    of_cells: MaterialOfCells | None = None,
    topology: "Topology | None" = None,
) -> Lattice:
    """Return the lattice of the valid cells; a cut cell counts with its part inside (collective).

    of_cells : material of each cell (lattice.region); None if ``material`` holds for all cells
    topology : topology of the cages; None to compute it
    """
    h = cages.grids.cell_size
    net = topology or topology_of(cages)
    is_solid = material.poisson is not None
    first_owned = net.cells[:, 0] < len(net.octants)
    further = ~first_owned & is_solid
    kept = np.concatenate([np.flatnonzero(first_owned), np.flatnonzero(further)])
    law = (_of_solid if is_solid else _of_springs)(net, h, material, of_cells)
    grids = cages.grids
    nodes_of_bodies = np.bincount(
        grids.body_of(net.ijk[: len(law.mass)]), minlength=len(grids.grids)
    )
    return Lattice(
        table=net.table,
        cell_size=h,
        nodes=cages.grids.node_positions(net.ijk),
        ghosts=net.ghosts,
        mass=law.mass,
        cells=net.corners,
        cell_kind=cages.kind,
        cell_share=np.ones(len(cages.kind))
        if cages.share is None
        else cages.share.mean(axis=(1, 2, 3)),
        springs=net.springs,
        springs_owned=net.springs_owned,
        rest_length=h * np.sqrt(KIND[net.direction]),
        stiffness=np.broadcast_to(law.springs, len(net.springs)).copy(),
        pinned=np.zeros(len(net.ijk), bool),
        local_cells=net.cells[kept],
        cells_owned=int(first_owned.sum()),
        cell_stiffness=np.broadcast_to(law.cells, len(net.cells))[kept],
        first_of_body=starts(net.table.comm.allreduce(nodes_of_bodies)),
        solid=law.solid and SolidCells(*(rows[kept] for rows in law.solid)),
    )


class Topology(NamedTuple):
    """Nodes, cells and springs of a rank, without material. Further fields are those of Lattice.

    corners : (c, 8) global corner nodes of the cells that this rank owns
    ijk     : (l, 3) grid index of the nodes, ghosts included
    octants : (owned, 8) bool, which of the 8 cells around each owned node are valid
    cells   : (d, 8) local corner nodes of all cells around the owned nodes
    share   : (d, 8) shares of their corners (geometry.fill_fractions); None if all cells are whole
    squares : (d, 3) their second moments (geometry.fill_fractions); None if all cells are whole
    direction : (s,) direction of each spring from its first end, as in DIRECTION
    sharing : (s,) number of cells that share each spring
    """

    table: SortedKeys
    corners: Indices
    ijk: Indices
    octants: Mask
    ghosts: Indices
    cells: Indices
    share: Rows | None
    squares: Rows | None
    springs: Indices
    springs_owned: int
    direction: Indices
    sharing: Indices


def topology_of(cages: Cages) -> Topology:
    """Return the nodes, cells and springs of this rank's part of the cages (collective)."""
    corner_keys = encode_morton(cages.ijk[:, None, :] + CORNERS)
    table = SortedKeys(cages.table.comm, corner_keys.ravel())
    corners = table.find(corner_keys)
    owned = len(table.keys)
    ijk, cells, octants = _local_cells(cages, table)
    ghosts = table.find(encode_morton(ijk[owned:]))
    share = cages.of_cells(ijk[cells[:, 0]], cages.share)
    share = None if share is None else share[:, *CORNERS.T]
    squares = cages.of_cells(ijk[cells[:, 0]], cages.squares)
    numbers = np.concatenate([table.first + np.arange(owned), ghosts])
    springs = _springs(cells, numbers, owned)
    return Topology(table, corners, ijk, octants, ghosts, cells, share, squares, *springs)


class LawConstants(NamedTuple):
    """The material data of a rank's nodes, springs and cells. A scalar holds for all items.

    mass    : (owned,) [kg]
    springs : (s,) stiffness [N/m]; for a solid, of the constant L
    cells   : (d,) stiffness of an edge inside a body of the cell's material [N/m]
    solid   : (d,) constants of a solid's cells; None if the law is springs
    """

    mass: Floats
    springs: float | Floats
    cells: float | Floats
    solid: SolidCells | None = None


def _of_springs(
    net: Topology, h: float, material: Material, of_cells: MaterialOfCells | None
) -> LawConstants:
    """Return masses and spring stiffnesses; a spring has the mean over the cells that share it."""
    if of_cells is None and net.share is None:
        mass: Floats = material.density * h**3 / 8 * net.octants.sum(axis=1)
        law = LawConstants(mass, material.spring, material.spring)
    else:
        owned = len(net.octants)
        made_of = _made_of(net, material, of_cells)
        share = np.ones((len(net.cells), 8)) if net.share is None else net.share
        of_pairs = shares_of_pairs(share)
        of_corners = made_of.density[:, None] * shares_of_mass(of_pairs)
        mass = h**3 / 8 * np.bincount(net.cells.ravel(), of_corners.ravel(), owned)[:owned]
        of_spring = _sums_of_springs(net, made_of.spring, of_pairs) / net.sharing
        law = LawConstants(mass, of_spring, share.mean(axis=1) * made_of.spring)
    if material.stiffness is not None:
        return law
    springs = calibrated_stiffness(law.springs, h, KIND[net.direction], net.sharing)
    return LawConstants(law.mass, springs, edge_stiffness(law.cells, h))


def _made_of(net: Topology, material: Material, of_cells: MaterialOfCells | None) -> CellMaterial:
    """Return the material of the cells around a rank's nodes, by ``of_cells`` if it is given."""
    if of_cells:
        return of_cells(net.ijk[net.cells[:, 0]])
    of_all = material.density, material.spring, material.poisson_ratio
    return CellMaterial(*(np.full(len(net.cells), value) for value in of_all))


def _of_solid(
    net: Topology, h: float, material: Material, of_cells: MaterialOfCells | None
) -> LawConstants:
    """Return masses, spring stiffnesses of L and cell constants of a solid.

    A corner's lumped mass is proportional to the diagonal of L, as with springs.
    """
    owned, count = len(net.octants), len(net.cells)
    made_of = _made_of(net, material, of_cells)
    shear, lame = lame_constants(made_of.spring, made_of.poisson)
    forms = np.broadcast_to(WHOLE, (count, len(WHOLE)))
    volume = np.ones(count)
    pairs = np.broadcast_to(laplacians(WHOLE[None], np.ones(1)), (count, 8, 8))
    cut = np.empty(0, np.int64)
    if net.share is not None and net.squares is not None:
        forms, pairs = forms.copy(), pairs.copy()
        cut = np.flatnonzero(net.share.min(axis=1) < 1)
        volume[cut] = net.share[cut].mean(axis=1)
        forms[cut] = forms_of(net.share[cut], net.squares[cut])
        pairs[cut] = laplacians(forms[cut], volume[cut])
    diagonal = np.diagonal(pairs, axis1=1, axis2=2).copy()
    of_corners = (made_of.density * volume / diagonal.sum(axis=1))[:, None] * diagonal
    mass = h**3 * np.bincount(net.cells.ravel(), of_corners.ravel(), owned)[:owned]
    if len(cut):
        pairs[cut] = bounding_laplacians(forms[cut], volume[cut])
    # 2 mu + 3 lambda times |grad u|^2 bounds the second variation at rest.
    modulus = 2 * shear + 3 * lame
    of_spring = _sums_of_springs(net, -h * modulus, pairs)
    cells = SolidCells(forms, h**3 * volume, shear, lame)
    return LawConstants(mass, of_spring, edge_stiffness(volume * made_of.spring, h), cells)


def _local_cells(cages: Cages, table: SortedKeys) -> tuple[Indices, Indices, Mask]:
    """Return this rank's nodes and the cells around its owned nodes.

    The result is

    - the grid index (l, 3) of owned and ghost nodes,
    - the local corner nodes (d, 8) of the cells,
    - the mask (owned, 8) of the valid cells around each owned node.
    """
    ijk = decode_morton(table.keys)
    around = encode_morton(ijk[:, None, :] - CORNERS)
    octants = cages.table.find(around) >= 0
    cell_keys = np.unique(around[octants])
    corner_keys = encode_morton(decode_morton(cell_keys)[:, None, :] + CORNERS)
    ghost_keys = np.setdiff1d(corner_keys, table.keys)
    keys = np.concatenate([table.keys, ghost_keys])
    order = np.argsort(keys)
    local = order[np.searchsorted(keys, corner_keys, sorter=order)]
    return decode_morton(keys), local, octants


def _sums_of_springs(net: Topology, values: Floats, share: Rows) -> Floats:
    """Return the weighted sum (s,) of cell ``values`` (d,) over the cells that share each spring.

    The order of summation does not depend on the rank.

    share : (d, 8, 8) weight of a cell's value for the spring between two of its corners
    """
    of_nodes = _sums_by_direction(net.cells, values, share, len(net.octants))
    sums: Floats = of_nodes[net.springs[:, 0], net.direction]
    return sums


@njit()
def _sums_by_direction(cells: Indices, values: Floats, share: Rows, owned: int) -> Rows:
    sums = np.zeros((owned, 27))
    for i in range(len(cells)):
        for a in range(8):
            if cells[i, a] < owned:
                for b in range(8):
                    sums[cells[i, a], DIRECTION[a, b]] += values[i] * share[i, a, b]
    return sums


@njit()
def _springs(cells: Indices, numbers: Indices, owned: int) -> tuple[Indices, int, Indices, Indices]:
    """Return the springs between the corners of cells.

    cells   : (d, 8) local corner nodes; nodes below ``owned`` are owned
    numbers : (l,) global node numbers

    Returns the local ends (s, 2), the number of owned springs, the directions (s,), and the number
    (s,) of cells that share each spring. Owned springs come first.
    """
    neighbour = np.full((owned, 27), -1, np.int32)
    sharing = np.zeros((owned, 27), np.uint8)
    for cell in cells:
        for a in range(8):
            if cell[a] < owned:
                for b in range(8):
                    neighbour[cell[a], DIRECTION[a, b]] = cell[b]
                    sharing[cell[a], DIRECTION[a, b]] += 1
    count = 0
    # Direction 13 is the node itself.
    for node in range(owned):
        for direction in range(27):
            end = neighbour[node, direction]
            count += end >= 0 and direction != 13 and (numbers[end] > numbers[node] or end >= owned)
    springs = np.empty((count, 2), np.int32)
    directions = np.empty(count, np.int64)
    shared = np.empty(count, np.int64)
    # Owned springs fill the arrays from the front, all further springs from the back.
    low, high = 0, count
    for node in range(owned):
        row = neighbour[node]
        for direction in np.argsort(numbers[row]):
            end = row[direction]
            if end < 0 or direction == 13:
                continue
            if numbers[end] > numbers[node]:
                s = low
                low += 1
            elif end >= owned:
                high -= 1
                s = high
            else:
                continue
            springs[s, 0], springs[s, 1] = node, end
            directions[s], shared[s] = direction, sharing[node, direction]
    return springs, low, directions, shared
