"""Pins and anchors: the nodes that each holds, what their edges cut, and their reactions.

Springs, and cells of a solid, that the edge of a clamp cuts: a pin holds nodes, but its region ends between them. Of a
spring from a free node to a held one a part theta is free, and only that gives: it is 1 / theta as stiff. Where the
held node sticks out of the body, as at a clamped face, the spring has been made of what is inside, a part sigma of its
length (cut_cells), and is 1 / (sigma theta) as stiff. Along a row of cells both are exact, and a clamp askew in
the grid is where it should be to second order, as Gibou, Fedkiw, Cheng and Kang (2002) have it for the Poisson
equation. A cell of a solid takes the mean of sigma theta over its pairs of a free and a held corner: along the clamp,
where that is too much, nothing strains.

Reactions: of a node that is held, what moves and pulls it leaves  m a + grad E - f_ext - push,  with which the pin or
anchor keeps it where it is. So the forces on a body add up: reactions + loads + pushes = sum of m a, as grad E adds up
to nothing.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows, like, to_host
from msmpetsc.comm import log
from msmpetsc.constraints.loads import Anchor
from msmpetsc.errors import InputError
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.lattice.region import Finder
from msmpetsc.scene.reading import Scene

LEAST = 0.1  # free part of a spring: what is stiffer costs iterations, and short explicit steps
HALVINGS = 20  # of the way to the edge

Within = Callable[[Positions], Mask]  # points (n, 3) [m] -> (n,) bool
Regions = Mapping[str, Mask]  # the table's key in the scene, "pin.0" -> its local nodes (l,) bool


@dataclass(frozen=True)
class Holders:
    """The pins of a scene and then its anchors, by their keys, and whose each node is.

    number  : (owned,) of the pin or anchor that has a node, the number of keys where none does
    centers : (a, 3) of mass of their nodes at rest [m]
    """

    keys: tuple[str, ...]
    number: Indices
    centers: Positions

    @classmethod
    def of_masks(cls, masks: dict[str, Mask], lattice: Lattice) -> "Holders":
        """Return those of the nodes (l,) of each table; of two tables on a node the first has it (collective)."""
        number = np.full(lattice.owned, len(masks))
        for holder, where in reversed([*enumerate(masks.values())]):
            number[where[: lattice.owned]] = holder
        mass = lattice.mass[:, None]
        sums = sums_by(number, np.hstack([mass * lattice.nodes[: lattice.owned], mass]), len(masks))
        whole = lattice.table.comm.allreduce(sums)
        return cls(
            tuple(masks), number, whole[:, :3] / np.maximum(whole[:, 3:], np.finfo(float).tiny)
        )

    def totals(self, forces: Rows) -> Rows:
        """Return the sum (a, 3) over the nodes of each of what holds nodes (owned, 3), of this rank's."""
        return sums_by(self.number, forces, len(self.keys))

    def torques(self, q: Positions, forces: Rows, points: Positions) -> Rows:
        """Return the sums (a, 3) [N m] of (q - p) x f over the nodes (owned, 3) of each, of this rank's.

        points : p (a, 3) [m] of each
        """
        of_node = like(q, np.vstack([points, np.zeros(3)]))[self.number]
        return self.totals(np.cross(q - of_node, forces))


def sums_by(number: Indices, vectors: Rows, count: int) -> Rows:
    """Return the sums (count, k) of vectors (n, k) by their numbers (n,), which are where these are."""
    sums = np.zeros((count, vectors.shape[1]))
    for which in range(count):
        sums[which] = to_host(vectors[number == which].sum(axis=0))
    return sums


def clamped(
    scene: Scene, lattice: Lattice, masks: Regions, finder: Finder, points: Positions
) -> Lattice:
    """Return the lattice with the springs, or cells, cut by pins and by anchors that never let go.

    points : (l, 3) of the bodies that nodes are nearest to [m]
    """
    lasting = (table for table in scene.tables("anchor") if table.table.stop is None)
    tables = [t for t in chain(scene.tables("pin"), lasting) if not t.table.region.is_of_mesh]
    held = np.any([np.zeros(len(points), bool), *(masks[table.key] for table in tables)], axis=0)

    def stiffer(free: Indices, fast: Indices) -> Floats:
        """Return how much stiffer (n,) what joins a free node (n,) to a held one (n,) is: 1 / (sigma theta)."""
        body = lattice.body[free]

        def within(x: Positions) -> Mask:
            where: Mask = np.any(
                [np.zeros(len(x), bool), *(finder.inside(t, x, body) for t in tables)], axis=0
            )
            return where

        start = lattice.nodes[free]
        theta = _free_part(within, start, lattice.nodes[fast])
        of_body = _free_part(within, start, points[fast])
        return np.maximum(of_body / theta**2, 1.0)  # sigma = theta / of_body

    if lattice.solid is not None:
        return _with_cut_cells(lattice, held, stiffer)
    a, b = lattice.springs.T
    cut = np.flatnonzero(held[a] != held[b])
    fast, free = np.where(held[a], (a, b), (b, a))[:, cut]
    stiffness = lattice.stiffness.copy()
    stiffness[cut] *= stiffer(free, fast)
    return replace(lattice, stiffness=stiffness)


def _with_cut_cells(
    lattice: Lattice, held: Mask, stiffer: Callable[[Indices, Indices], Floats]
) -> Lattice:
    """Return a solid whose cells with free and held corners are stiffer by the mean free part of their pairs."""
    assert lattice.solid is not None
    fast, corners = held[lattice.local_cells], lattice.local_cells
    cell, far, near = np.nonzero(fast[:, :, None] & ~fast[:, None, :])
    free = 1 / stiffer(corners[cell, near], corners[cell, far])
    mean = np.ones(len(corners))
    cut = np.unique(cell)
    mean[cut] = (np.bincount(cell) / np.maximum(np.bincount(cell, free), LEAST**2))[cut]
    solid = lattice.solid._replace(shear=mean * lattice.solid.shear, lame=mean * lattice.solid.lame)
    return replace(lattice, solid=solid)


def _free_part(within: Within, start: Positions, end: Positions) -> Floats:
    """Return which part (n,) of the way from start to end (n, 3) lies before what is ``within``.

    It is LEAST at least, and 1 where the way does not lead in from outside.
    """
    leads_in = within(end) & ~within(start)
    low, high = np.zeros(len(start)), np.ones(len(start))
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        inside = within(start + middle[:, None] * (end - start))
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    return np.where(leads_in, np.maximum(high, LEAST), 1.0)


def taken(
    comm: MPI.Comm, scene: Scene, lattice: Lattice, anchors: list[Anchor], masks: Regions
) -> tuple[str, ...]:
    """Return what anchors and forces take, in words; warn of what is overruled (collective).

    lattice : with its pins
    anchors : each with the nodes that it leads, those of its region aside that a pin or an earlier anchor has
    Raises InputError on all ranks for an anchor or a force that does nothing.
    """

    def count(where: Mask) -> int:
        return int(comm.allreduce(int(where[: lattice.owned].sum())))

    words = []
    for table, anchor in zip(scene.tables("anchor"), anchors, strict=True):
        where = masks[table.key]
        nodes, pinned, led = map(count, (where, where & lattice.pinned, anchor.where))
        if led < nodes:
            text = f"{table.key}: of {nodes} nodes in its region pins hold {pinned}, "
            text += f"and anchors before it lead {nodes - pinned - led}"
            if not led:
                raise InputError(f"{text}: it leads none")
            log.warning("%s, which it does not lead", text)
        words.append(f"{table.key} leads {led} nodes")
    for table in scene.tables("force"):
        where, force = masks[table.key], table.table
        until = math.inf if force.stop is None else force.stop
        lasting = [
            a.where for a in anchors if a.stop is None or a.stop >= until
        ]  # hold all the while
        nodes = count(where)
        held = count(where & reduce(np.logical_or, lasting, lattice.pinned))
        if held == nodes and force.pulls:
            why = f"of {nodes} nodes in its region none is free while it acts, pins and anchors hold all"
            raise InputError(f"{table.key} moves nothing: {why}")
        words.append(f"{table.key} pulls {nodes} nodes" + f" ({held} of them held)" * bool(held))
    return tuple(words)
