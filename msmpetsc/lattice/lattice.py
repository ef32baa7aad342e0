"""The lattice of a body: cell corners become masses, pairs of corners within a cell become springs.

Each rank holds the nodes it owns, the ghost nodes that its springs reach, and every spring with an
end that it owns. Global node numbers follow Morton order, so they do not depend on the number of ranks.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array, Floats, Indices, Mask, Positions, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.comm import SortedKeys, starts
from msmpetsc.geometry.cages import Cages
from msmpetsc.geometry.grid import decode_morton, encode_morton
from msmpetsc.lattice.cell_moments import WHOLE, forms_of, laplacians
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

# the index in a 3 x 3 x 3 block of nodes of corner b seen from corner a
DIRECTION = (CORNERS[None, :, :] - CORNERS[:, None, :] + 1) @ np.array([9, 3, 1])
KIND = ((np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), axis=1) - 1) ** 2).sum(axis=1)
NO_CELLS = np.empty((0, 8), np.int64)


class SolidCells(NamedTuple):
    """What a law of solids takes of each of a lattice's ``local_cells`` (elasticity.neo_hookean).

    forms  : (d, 13) of strain within a cell (lattice.cell_moments)
    volume : (d,) of what is inside the surface [m^3]
    shear, lame : (d,) mu and lambda [Pa]
    """

    forms: Rows
    volume: Floats
    shear: Floats
    lame: Floats


@dataclass(frozen=True)
class Lattice:
    """This rank's part of a lattice. Local node numbers: the ``owned`` nodes first, then the ghosts.

    table       : global node numbers by grid key; ``table.first`` is the first owned one
    nodes       : (l, 3) rest positions [m]
    ghosts      : (l - owned,) global numbers of the ghost nodes
    mass        : (owned,) [kg]
    cells       : (c, 8) global corner nodes of the cells this rank owns
    cell_kind   : (c,) geometry.cages' BOUNDARY or INTERIOR
    springs     : (s, 2) local ends; the first ``springs_owned`` belong to this rank, with the
                  lower-numbered end first, the others to the rank of their lower-numbered end
    rest_length : (s,) distance of their ends at rest [m]
    stiffness   : (s,) [N/m]; with ``solid`` of springs of no rest length, whose L is no less than the Hessian at rest
    pinned      : (l,) bool, nodes that do not move
    local_cells : (d, 8) local corner nodes of the cells that belong to this rank, as their first corner does: the
                  first ``cells_owned``; then, only of a solid, of all others around the owned nodes
    cell_stiffness : (d,) [N/m] of an edge among cells of the same material as each of them
    cell_share  : (c,) of each of ``cells`` that lies inside the surface, and so counts [-]
    first_of_body : (b,) global number of the first node of each body; a body's nodes follow each other
    solid       : where the law is neo-Hookean; None where it is of springs
    viscous     : viscosity of a solid in its steps over its stiffness, beta / tau (elasticity.viscosity) [-]
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
        """Return the number of the body that each of some nodes, by their global numbers, belongs to."""
        return np.searchsorted(self.first_of_body, numbers, side="right") - 1

    @property
    def body(self) -> Indices:
        """Number (l,) of the body that each local node belongs to."""
        return self.body_of(self.global_numbers)

    def stiffest(self, comm: MPI.Comm) -> float:
        """Return the greatest stiffness of any spring, or of such as a solid would have, [N/m] (collective)."""
        stiffness = self.stiffness if self.solid is None else self.cell_stiffness
        return float(comm.allreduce(stiffness.max(initial=0), MPI.MAX))

    def pin(self, where: Mask) -> "Lattice":
        """Return this lattice with the nodes ``where`` (l,) bool held fast."""
        return replace(self, pinned=self.pinned | where)


def build_lattice(
    cages: Cages,
    material: Material,
    of_cells: MaterialOfCells | None = None,
    topology: "Topology | None" = None,
) -> Lattice:
    """Build masses and springs of valid cells, of boundary cells what is inside (cut_cells; collective).

    of_cells : what each cell is made of, where that is not ``material`` for all (lattice.region)
    topology : that of the cages, where it is known already
    """
    h, net = cages.grids.cell_size, topology or topology_of(cages)
    is_solid = material.poisson is not None
    first_owned = net.cells[:, 0] < len(net.octants)
    others = ~first_owned & is_solid
    kept = np.concatenate([np.flatnonzero(first_owned), np.flatnonzero(others)])
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
    """Nodes, cells and springs of a rank before they are of a material. Fields as in Lattice, or as said here.

    corners : (c, 8) global corner nodes of the cells this rank owns
    ijk     : (l, 3) grid index of the nodes, owned and ghosts
    octants : (owned, 8) bool, which of the 8 cells around each owned node are valid
    cells   : (c, 8) local corner nodes of all cells around the owned nodes
    share   : (c, 8) of the corners of these cells; None where all are whole
    squares : (c, 3) of what is inside of them (geometry.fill_fractions); None where all are whole
    direction : (s,) of the springs from their first ends, as DIRECTION has it
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
    """Return this rank's nodes, cells and springs (collective)."""
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
    return Topology(
        table,
        corners,
        ijk,
        octants,
        ghosts,
        cells,
        share,
        squares,
        *_springs(cells, numbers, owned),
    )


class LawConstants(NamedTuple):
    """What a lattice has of its material, of all cells around a rank's nodes.

    mass    : (owned,) [kg]
    springs : (s,) stiffness [N/m], or one for all; of a solid that of the constant L
    cells   : (c,) stiffness [N/m] of an edge among cells like each, or one for all
    solid   : None of springs
    """

    mass: Floats
    springs: float | Floats
    cells: float | Floats
    solid: SolidCells | None = None


def _of_springs(
    net: Topology, h: float, material: Material, of_cells: MaterialOfCells | None
) -> LawConstants:
    """Return the constants of springs: of each the mean over the cells that share it."""
    if of_cells is None and net.share is None:
        mass: Floats = material.density * h**3 / 8 * net.octants.sum(axis=1)
        law = LawConstants(mass, material.spring, material.spring)
    else:
        owned, cells, made_of = len(net.octants), len(net.cells), _made_of(net, material, of_cells)
        share = np.ones((cells, 8)) if net.share is None else net.share
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
    """Return what the cells around a rank's nodes are made of, all alike where no function tells."""
    if of_cells:
        return of_cells(net.ijk[net.cells[:, 0]])
    of_all = material.density, material.spring, material.poisson_ratio
    return CellMaterial(*(np.full(len(net.cells), value) for value in of_all))


def _of_solid(
    net: Topology, h: float, material: Material, of_cells: MaterialOfCells | None
) -> LawConstants:
    """Return the constants of a solid: as with springs each corner's mass goes as the diagonal of L."""
    owned, count, made_of = len(net.octants), len(net.cells), _made_of(net, material, of_cells)
    shear, lame = lame_constants(made_of.spring, made_of.poisson)
    forms, volume = np.broadcast_to(WHOLE, (count, len(WHOLE))), np.ones(count)
    pairs = np.broadcast_to(laplacians(WHOLE[None], np.ones(1)), (count, 8, 8))
    if net.share is not None and net.squares is not None:
        forms, pairs = forms.copy(), pairs.copy()
        cut = np.flatnonzero(net.share.min(axis=1) < 1)
        volume[cut] = net.share[cut].mean(axis=1)
        forms[cut] = forms_of(net.share[cut], net.squares[cut])
        pairs[cut] = laplacians(forms[cut], volume[cut])
    diagonal = np.diagonal(pairs, axis1=1, axis2=2)
    of_corners = (made_of.density * volume / diagonal.sum(axis=1))[:, None] * diagonal
    mass = h**3 * np.bincount(net.cells.ravel(), of_corners.ravel(), owned)[:owned]
    most = 2 * shear + 3 * lame  # of |grad u|^2 in the second variation at rest
    of_spring = _sums_of_springs(net, -h * most, pairs)
    cells = SolidCells(forms, h**3 * volume, shear, lame)
    return LawConstants(mass, of_spring, edge_stiffness(volume * made_of.spring, h), cells)


def _local_cells(cages: Cages, table: SortedKeys) -> tuple[Indices, Indices, Mask]:
    """Return the cells around the owned nodes.

    They are: grid index (l, 3) of owned and ghost nodes, local corner nodes (c, 8) of the cells,
    and which of the 8 cells around each owned node are valid, (owned, 8) bool.
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
    """Return the sum (s,) of ``values`` (c,) of cells that share each spring, in one order on all ranks.

    share : (c, 8, 8) of its value that a cell gives to the spring between two of its corners
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
    """Return the springs between the corners of cells, each once.

    cells   : (c, 8) local nodes; numbers (l,) global; nodes below ``owned`` are owned
    returns : (s, 2) local ends, how many this rank owns, direction (s,), cells sharing each (s,)
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
    for node in range(owned):
        for direction in range(27):
            far = neighbour[node, direction]
            count += far >= 0 and direction != 13 and (numbers[far] > numbers[node] or far >= owned)
    springs = np.empty((count, 2), np.int32)
    directions = np.empty(count, np.int64)
    shared = np.empty(count, np.int64)
    low, high = 0, count  # springs of this rank fill the front, the others the back
    for node in range(owned):
        row = neighbour[node]
        for direction in np.argsort(numbers[row]):
            far = row[direction]
            if far < 0 or direction == 13:
                continue
            if numbers[far] > numbers[node]:
                s = low
                low += 1
            elif far >= owned:
                high -= 1
                s = high
            else:
                continue
            springs[s, 0], springs[s, 1] = node, far
            directions[s], shared[s] = direction, sharing[node, direction]
    return springs, low, directions, shared
