"""The lattice of bodies: cell corners become masses, pairs of corners in a cell become springs.

Each rank has its owned nodes, all springs of these nodes, and the ghosts: nodes of other ranks at
the ends of its springs. Global node numbers follow Morton order, so they do not depend on the
number of ranks.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array, Floats, Indices, Mask, Positions, to_host
from msmpetsc.comm import starts
from msmpetsc.geometry.cages import Cages
from msmpetsc.geometry.partition import SortedKeys
from msmpetsc.lattice.mass_and_stiffness import (
    SolidCells,
    law_of_solid,
    law_of_springs,
    stiffness_of_solid,
)
from msmpetsc.lattice.material import MaterialOfCells
from msmpetsc.lattice.topology import DIRECTION_KIND, SpringNet, Topology, topology_of
from msmpetsc.scene.body import Material

NO_CELLS = np.empty((0, 8), np.int64)


class Springs(NamedTuple):
    """Local ends (s, 2), rest lengths (s,) [m] and stiffnesses (s,) [N/m] of springs."""

    ends: Indices
    rest_length: Floats
    stiffness: Floats

    @classmethod
    def of(cls, net: SpringNet, h: float, stiffness: Floats) -> "Springs":
        """Return the springs of a net on cells of size h [m]."""
        return cls(net.ends, h * np.sqrt(DIRECTION_KIND[net.direction]), stiffness)


NO_SPRINGS = Springs(np.empty((0, 2), np.int32), np.empty(0), np.empty(0))


def _springs_of_solid(
    net: Topology, h: float, order: Indices | slice, solid: SolidCells
) -> Springs:
    """Return the springs whose L bounds a solid's Hessian at rest.

    order : (d,) row of ``solid`` for each cell of the topology
    """
    springs = net.springs()
    cells = SolidCells(*(to_host(rows)[order] for rows in solid))
    return Springs.of(springs, h, stiffness_of_solid(net, springs, h, cells))


@dataclass(frozen=True)
class Lattice:
    """This rank's part of a lattice. Local numbers begin with the ``owned`` nodes; ghosts follow.

    table       : global node numbers by grid key; the first owned node has ``table.first``
    nodes       : (l, 3) rest positions [m]
    ghosts      : (l - owned,) global numbers of the ghost nodes
    mass        : (owned,) [kg]
    cells       : (c, 8) global corner nodes of the cells that this rank owns
    cell_kind   : (c,) BOUNDARY or INTERIOR of geometry.cages
    springs     : (s, 2) local ends. This rank owns the first ``springs_owned``, whose first end has
                  the lower global number. The rank of its lower-numbered end owns a further spring.
                  A solid has no springs before ``with_springs``.
    rest_length : (s,) distance of the ends at rest [m]
    stiffness   : (s,) [N/m]
    fixed       : (l, 3) bool, components of nodes that do not move
    local_cells : (d, 8) local corner nodes of cells. The first ``cells_owned`` are the cells whose
                  first corner this rank owns. For a solid all cells around owned nodes follow.
    cell_stiffness : (d,) stiffness of an edge spring inside a body of the cell's material [N/m]
    cell_fill   : (c,) fraction of each of ``cells`` that lies inside the surface [-]
    first_of_body : (b,) global number of each body's first node; a body's numbers are consecutive
    solid       : constants of a neo-Hookean solid; None if the law is springs
    volumetric  : name of a solid's volumetric energy (elasticity.neo_hookean)
    viscous     : beta / tau [-], viscosity of a step over the stiffness (elasticity.viscosity)
    pressed     : surfaces under pressure (lattice.embedded_surface.SurfacePart)
    make_springs : function that makes the springs of a solid from ``solid``; None if they are made
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
    fixed: Mask
    local_cells: Indices = field(default_factory=lambda: NO_CELLS)
    cells_owned: int = 0
    cell_stiffness: Floats = field(default_factory=lambda: np.empty(0))
    cell_fill: Floats = field(default_factory=lambda: np.empty(0))
    first_of_body: Indices = field(default_factory=lambda: np.zeros(1, np.int64))
    solid: SolidCells | None = None
    volumetric: str = "quadratic"
    viscous: float = 0.0
    pressed: tuple[Any, ...] = ()
    make_springs: Callable[[SolidCells], Springs] | None = None

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

    def longest_side(self) -> float:
        """Return the longest side [m] of the bounding box of all nodes at rest (collective)."""
        own = [to_host(self.nodes.min(axis=0)), to_host(self.nodes.max(axis=0))]
        low, high = np.array(self.table.comm.allgather(own)).transpose(1, 0, 2)
        return float((high.max(axis=0) - low.min(axis=0)).max())

    @cached_property
    def pinned(self) -> Mask:
        """Mask (l,) of the nodes that do not move."""
        pinned: Mask = self.fixed.all(axis=1)
        return pinned

    @cached_property
    def rollers(self) -> tuple[Indices, ...]:
        """Nodes (h,) and their fixed components (h,), for nodes that are fixed in part."""
        return np.nonzero(self.fixed & ~self.pinned[:, None])

    def with_springs(self) -> "Lattice":
        """Return this lattice with its springs.

        The springs of a solid are no part of its energy: their L bounds its Hessian at rest.
        """
        if self.make_springs is None or self.solid is None:
            return self
        springs = self.make_springs(self.solid)
        return replace(
            self,
            springs=springs.ends,
            rest_length=springs.rest_length,
            stiffness=(1 + self.viscous) * springs.stiffness,
            make_springs=None,
        )

    def pin(self, where: Mask) -> "Lattice":
        """Return this lattice with further nodes (l,) or components (l, 3) ``where`` fixed."""
        return replace(self, fixed=self.fixed | where.reshape(len(where), -1))


def build_lattice(
    cages: Cages,
    material: Material,
    of_cells: MaterialOfCells | None = None,
    topology: Topology | None = None,
) -> Lattice:
    """Return the lattice of the valid cells; a cut cell counts with its part inside (collective).

    of_cells : materials by key of a cell (lattice.cell_materials); None for ``material`` everywhere
    topology : topology of the cages; None to compute it
    """
    h = cages.grids.cell_size
    net = topology or topology_of(cages)
    is_solid = material.poisson is not None
    first_owned = net.cells[:, 0] < len(net.octants)
    further = ~first_owned & is_solid
    # a slice copies nothing, so that whole cells still share one row of constants
    kept: Indices | slice = slice(None)
    order: Indices | slice = slice(None)
    if not first_owned.all():
        kept = np.concatenate([np.flatnonzero(first_owned), np.flatnonzero(further)])
        order = np.argsort(kept)
    springs, make_springs = NO_SPRINGS, None
    if is_solid:
        make_springs = partial(_springs_of_solid, net, h, order)
        law, springs_owned = law_of_solid(net, h, material, of_cells), net.count_springs()
    else:
        found = net.springs()
        law, springs_owned = law_of_springs(net, found, h, material, of_cells), found.owned
        springs = Springs.of(found, h, law.springs)
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
        cell_fill=cages.fills.mean(axis=(1, 2, 3)),
        springs=springs.ends,
        springs_owned=springs_owned,
        rest_length=springs.rest_length,
        stiffness=springs.stiffness,
        fixed=np.zeros((len(net.ijk), 3), bool),
        local_cells=net.cells[kept],
        cells_owned=int(first_owned.sum()),
        cell_stiffness=law.cells[kept],
        first_of_body=starts(net.table.comm.allreduce(nodes_of_bodies)),
        solid=law.solid and SolidCells(*(rows[kept] for rows in law.solid)),
        volumetric=material.volume,
        make_springs=make_springs,
    )
