"""Springs that the edge of a clamp cuts.

A pin holds nodes, but its region ends between them. Of a spring from a free node to a held one a part theta is free,
and only that gives: it is 1 / theta as stiff. Where the held node sticks out of the body, as at a clamped face, the
spring has been made of what is inside, a part sigma of its length (boundary_cells), and is 1 / (sigma theta) as stiff.
Along a row of cells both are exact, and a clamp askew in the grid is where it should be to second order, as Gibou,
Fedkiw, Cheng and Kang (2002) have it for the Poisson equation.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import chain

import numpy as np

from msmpetsc.backend.arrays import Floats, Mask, Positions
from msmpetsc.constraints.coverage import Regions
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.lattice.region import Finder
from msmpetsc.scene.reading import Scene

LEAST = 0.1  # free part of a spring: what is stiffer costs iterations, and short explicit steps
HALVINGS = 20  # of the way to the edge

Within = Callable[[Positions], Mask]  # points (n, 3) [m] -> (n,) bool


def clamped(scene: Scene, lattice: Lattice, masks: Regions, finder: Finder, points: Positions) -> Lattice:
    """Return the lattice with the springs that pins, and anchors that never let go, cut.

    points : (l, 3) of the bodies that nodes are nearest to [m]
    """
    if lattice.solid is not None:
        return lattice
    lasting = (table for table in scene.tables("anchor") if table.table.stop is None)
    tables = [t for t in chain(scene.tables("pin"), lasting) if t.table.region.painted is None]
    held = np.any([np.zeros(len(points), bool), *(masks[table.key] for table in tables)], axis=0)
    a, b = lattice.springs.T
    cut = np.flatnonzero(held[a] != held[b])
    fast, free = np.where(held[a], (a, b), (b, a))[:, cut]
    body = lattice.body[free]

    def within(x: Positions) -> Mask:
        where: Mask = np.any([np.zeros(len(x), bool), *(finder.inside(table, x, body) for table in tables)], axis=0)
        return where

    start, end = lattice.nodes[free], lattice.nodes[fast]
    theta, of_body = _free_part(within, start, end), _free_part(within, start, points[fast])
    stiffness = lattice.stiffness.copy()
    stiffness[cut] *= np.maximum(of_body / theta**2, 1.0)  # sigma = theta / of_body
    return replace(lattice, stiffness=stiffness)


def _free_part(within: Within, start: Positions, end: Positions) -> Floats:
    """Return which part (n,) of the way from ``start`` to ``end`` (n, 3) lies before what is ``within``.

    It is LEAST at least, and 1 where the way does not lead in from outside.
    """
    leads_in = within(end) & ~within(start)
    low, high = np.zeros(len(start)), np.ones(len(start))
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        inside = within(start + middle[:, None] * (end - start))
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    return np.where(leads_in, np.maximum(high, LEAST), 1.0)
