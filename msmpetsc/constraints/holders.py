"""Pins and anchors: their nodes, springs and cells that the edge of a clamp cuts, and reactions.

A pin's region ends between nodes. A spring from a free to a fixed node deforms only outside the
region, on the fraction theta of its length. So its stiffness is multiplied by 1 / theta. If the
fixed node lies outside the body, as at a clamped face, the factor is 1 / (sigma theta). The spring
then stands for the fraction sigma of its length (cut_cells). Along a row of cells both factors are
exact. A clamp of springs oblique to the grid is second-order accurate, like the Poisson equation of
Gibou, Fedkiw, Cheng and Kang (2002). A solid's cell uses the mean of sigma theta over its pairs of
a free and a fixed corner. This is too stiff along the clamp, but no strain occurs there. An oblique
clamp of a solid is first-order accurate: its place errs by about 0.1 cells.

A pin of single components, a roller, stiffens no spring: it ends at its nodes, because their other
components are free.

The reaction on a fixed node is  m a + grad E - f_ext - push.  grad E sums to zero over a body, so
the sum of reactions, loads and pushes is the sum of m a.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows, like, to_host
from msmpetsc.comm import log
from msmpetsc.constraints.anchors import Anchor
from msmpetsc.errors import InputError
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.lattice.region import Finder
from msmpetsc.scene.motion import Pin
from msmpetsc.scene.schema import OfBody

# least free fraction theta of a spring [-]; stiff springs cost iterations and substeps
LEAST = 0.1
# bisections towards the edge of a region [-]; the edge is exact to 1e-6 of a spring
HALVINGS = 20

# points (n, 3) [m] -> whether each lies in a region, (n,)
Within = Callable[[Positions], Mask]
# local nodes (l,) bool by the table's key in the scene, such as "pin.0"
Regions = Mapping[str, Mask]


@dataclass(frozen=True)
class Holders:
    """Holders, the pins and then the anchors of a scene, and the holder of each component.

    keys    : keys of the holders' tables in the scene
    number  : (owned, 3) index in ``keys`` of a component's holder; len(keys) if it is free
    centers : (a, 3) centre of mass of each holder's nodes at rest [m]
    """

    keys: tuple[str, ...]
    number: Indices
    centers: Positions

    @classmethod
    def of_masks(cls, masks: dict[str, Mask], lattice: Lattice) -> "Holders":
        """Return the holders from masks (l, 3) of their components (collective).

        A component in several masks belongs to the first.
        """
        number = np.full((lattice.owned, 3), len(masks), np.int32)
        for holder, where in reversed([*enumerate(masks.values())]):
            number[where[: lattice.owned]] = holder
        mass = lattice.mass[:, None]
        moments = np.hstack([mass * lattice.nodes[: lattice.owned], mass])
        sums = [moments[(number == holder).any(axis=1)].sum(axis=0) for holder in range(len(masks))]
        whole = lattice.table.comm.allreduce(np.array(sums).reshape(-1, 4))
        return cls(
            tuple(masks), number, whole[:, :3] / np.maximum(whole[:, 3:], np.finfo(float).tiny)
        )

    def totals(self, forces: Rows) -> Rows:
        """Return the sum (a, 3) of ``forces`` (owned, 3) over each holder's nodes on this rank."""
        return sums_by(self.number, forces, len(self.keys))

    def torques(self, q: Positions, forces: Rows, points: Positions) -> Rows:
        """Return the torque (a, 3) [N m] of ``forces`` (owned, 3) on each holder's owned nodes.

        points : (a, 3) reference point of each holder [m]
        """
        torques = np.zeros((len(self.keys), 3))
        for holder, point in enumerate(points):
            taken = np.where(self.number == holder, forces, 0.0)
            moments = to_host((q - like(q, point)).T @ taken)
            torques[holder] = (moments - moments.T)[[1, 2, 0], [2, 0, 1]]
        return torques


def sums_by(number: Indices, vectors: Rows, count: int) -> Rows:
    """Return the sum (count, k) of vectors (n, k) for each number below count.

    number : (n, 1) number of each vector, or (n, k) of each component, on the vectors' device
    """
    sums = np.zeros((count, vectors.shape[1]))
    for which in range(count):
        sums[which] = to_host(np.where(number == which, vectors, 0.0).sum(axis=0))
    return sums


def clamped(
    holders: Sequence[OfBody],
    lattice: Lattice,
    masks: Regions,
    finder: Finder,
    points: Positions,
) -> Lattice:
    """Return the lattice with stiffer springs, or cells, at the edges of pins and lasting anchors.

    A lasting anchor has no ``stop``.

    holders : tables of pins and anchors
    masks   : local nodes (l,) of each table
    points  : (l, 3) body points nearest to the nodes [m]
    """
    lasting = (t for t in holders if isinstance(t.table, Pin) or t.table.stop is None)
    tables = [t for t in lasting if all(t.table.fixed) and not t.table.region.is_of_mesh]
    is_fixed = np.any(
        [np.zeros(len(points), bool), *(masks[table.key] for table in tables)], axis=0
    )

    def stiffening(free: Indices, fixed: Indices) -> Floats:
        """Return 1 / (sigma theta) (n,) [-] for pairs of a free (n,) and a fixed node (n,)."""
        body = lattice.body[free]

        def within(x: Positions) -> Mask:
            where: Mask = np.any(
                [np.zeros(len(x), bool), *(finder.inside(t, x, body) for t in tables)], axis=0
            )
            return where

        start = lattice.nodes[free]
        theta = _free_fraction(within, start, lattice.nodes[fixed])
        of_body = _free_fraction(within, start, points[fixed])
        # sigma = theta / of_body
        return np.maximum(of_body / theta**2, 1.0)

    if lattice.solid is not None:
        return _with_cut_cells(lattice, is_fixed, stiffening)
    a, b = lattice.springs.T
    cut = np.flatnonzero(is_fixed[a] != is_fixed[b])
    fixed, free = np.where(is_fixed[a], (a, b), (b, a))[:, cut]
    stiffness = lattice.stiffness.copy()
    stiffness[cut] *= stiffening(free, fixed)
    return replace(lattice, stiffness=stiffness)


def _with_cut_cells(
    lattice: Lattice, is_fixed: Mask, stiffening: Callable[[Indices, Indices], Floats]
) -> Lattice:
    """Return a solid whose cells with both free and fixed corners are stiffer.

    The factor of a cell is 1 over the mean of sigma theta, over its pairs of a free and a fixed
    corner.
    """
    assert lattice.solid is not None
    corners = lattice.local_cells
    corner_fixed = is_fixed[corners]
    cell, fixed, free = np.nonzero(corner_fixed[:, :, None] & ~corner_fixed[:, None, :])
    sigma_theta = 1 / stiffening(corners[cell, free], corners[cell, fixed])
    factor = np.ones(len(corners))
    cut = np.unique(cell)
    factor[cut] = (np.bincount(cell) / np.maximum(np.bincount(cell, sigma_theta), LEAST**2))[cut]
    solid = lattice.solid
    solid = solid._replace(shear=factor * solid.shear, lame=factor * solid.lame)
    return replace(lattice, solid=solid)


def _free_fraction(within: Within, start: Positions, end: Positions) -> Floats:
    """Return the fraction (n,) of each segment, from start to end (n, 3), outside the region.

    It is at least LEAST, and 1 if the segment does not lead from outside into the region.
    """
    enters = within(end) & ~within(start)
    low, high = np.zeros(len(start)), np.ones(len(start))
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        inside = within(start + middle[:, None] * (end - start))
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    return np.where(enters, np.maximum(high, LEAST), 1.0)


def taken(
    comm: MPI.Comm,
    tables: tuple[Sequence[OfBody], Sequence[OfBody], Sequence[OfBody]],
    lattice: Lattice,
    anchors: list[Anchor],
    masks: Regions,
) -> tuple[str, ...]:
    """Return how many nodes rollers, anchors and forces have, in words; warn of conflicts.

    Collective.

    tables  : tables of pins, anchors and forces
    lattice : the lattice with its pins
    anchors : the anchors without components that a pin or an earlier anchor holds
    masks   : local nodes (l,) in the region of each table

    Raises InputError on all ranks if an anchor or a force has no effect.
    """

    def count(where: Mask) -> int:
        return int(comm.allreduce(int(where[: lattice.owned].sum())))

    pins, leading, forces = tables
    words = [
        f"{table.key} holds {', '.join(table.table.fix)} of {count(masks[table.key])} nodes"
        for table in pins
        if not all(table.table.fixed)
    ]
    for table, anchor in zip(leading, anchors, strict=True):
        where = masks[table.key]
        nodes = count(where)
        pinned = count(where & lattice.fixed[:, table.table.fixed].all(axis=1))
        anchored = count(anchor.where.any(axis=1))
        if anchored < nodes:
            text = f"{table.key}: of {nodes} nodes in its region pins hold {pinned}, "
            text += f"and anchors before it lead {nodes - pinned - anchored}"
            if not anchored:
                raise InputError(f"{text}: it leads none")
            log.warning("%s, which it does not lead", text)
        words.append(f"{table.key} leads {anchored} nodes")
    for table in forces:
        where, force = masks[table.key], table.table
        until = math.inf if force.stop is None else force.stop
        # an anchor cancels a force only if it holds the node as long as the force acts
        lasting = [a.where for a in anchors if a.stop is None or a.stop >= until]
        nodes = count(where)
        fixed = count(where & reduce(np.logical_or, lasting, lattice.fixed).all(axis=1))
        if fixed == nodes and force.pulls:
            raise InputError(
                f"{table.key} moves nothing: of {nodes} nodes in its region none is free "
                "while it acts, pins and anchors hold all"
            )
        words.append(f"{table.key} pulls {nodes} nodes" + f" ({fixed} of them held)" * bool(fixed))
    return tuple(words)
