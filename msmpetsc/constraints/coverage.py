"""The nodes that pins, anchors, forces and parts of a scene reach, and which of them do nothing or not what they say.

What could not have any effect at all is refused; what is overruled in part is warned of.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from itertools import chain

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Mask, Positions
from msmpetsc.comm import log
from msmpetsc.constraints.loads import SAME, Anchor, within
from msmpetsc.errors import InputError
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.lattice.region import Finder
from msmpetsc.scene.motion import Force
from msmpetsc.scene.obstacles import ObstacleTable
from msmpetsc.scene.reading import Scene
from msmpetsc.scene.time import Time

NODES = ("pin", "anchor", "force")  # tables whose regions mean nodes
Regions = Mapping[str, Mask]  # the table's key in the scene, "pin.0" -> its local nodes (l,) bool


@dataclass(frozen=True)
class Reach:
    """The nodes of a table's region, over all ranks.

    nodes : how many the region holds
    held  : how many of them are not the table's own, for a pin or an anchor that comes before it holds them
    kind  : "pin", "anchor" or "force"
    """

    key: str
    nodes: int
    held: int
    kind: str


def regions(scene: Scene, lattice: Lattice, finder: Finder, points: Positions) -> dict[str, Mask]:
    """Return the nodes of each pin, anchor and force (collective). Raises InputError for a region without nodes.

    points : (l, 3) of the bodies that nodes are nearest to [m]
    """
    tables = chain.from_iterable(scene.tables(kind) for kind in NODES)
    return {table.key: finder.find(table, lattice, points) for table in tables}


def reach_of(
    comm: MPI.Comm, scene: Scene, lattice: Lattice, anchors: list[Anchor], masks: Regions, finder: Finder
) -> tuple[Reach, ...]:
    """Return the reach of pins, anchors and forces in this order; warn of what is overruled (collective).

    lattice : with its pins
    anchors : each with the nodes that it leads, those of its region aside that a pin or an earlier anchor has
    Raises InputError on all ranks for an anchor or a force that does nothing.
    """

    def count(where: Mask) -> int:
        return int(comm.allreduce(int(where[: lattice.owned].sum())))

    reaches, pinned = [], np.zeros_like(lattice.pinned)
    for pin in scene.tables("pin"):
        where = masks[pin.key]
        reaches.append(Reach(pin.key, count(where), count(where & pinned), "pin"))
        pinned = pinned | where
    for number, (table, anchor) in enumerate(zip(scene.tables("anchor"), anchors, strict=True)):
        where = masks[table.key]
        reach = Reach(table.key, count(where), count(where & ~anchor.where), "anchor")
        reaches.append(reach)
        same = (before.where for before in anchors[:number] if _leads_alike(before, anchor))
        alike = reduce(np.logical_or, same, np.zeros_like(pinned))
        _warn_of_overruled(reach, count(where & pinned), count(where & ~anchor.where & ~pinned & ~alike))
    for table in scene.tables("force"):
        where, force = masks[table.key], table.table
        held = where & _held_while(force, lattice.pinned, anchors)
        reaches.append(Reach(table.key, count(where), count(held), "force"))
        if reaches[-1].held == reaches[-1].nodes and force.pulls:
            raise InputError(
                f"{table.key} moves nothing: of the {_nodes(reaches[-1].nodes)} in its region none is free while it "
                "acts, pins and anchors hold all"
            )
    _warn_of_idle_parts(comm, scene, lattice, anchors, finder)
    _note_what_never_acts(scene)
    return tuple(reaches)


def _leads_alike(a: Anchor, b: Anchor) -> bool:
    """Return whether it does not matter which of two anchors has a node: path, center and stop are the same."""
    same = np.array_equal(a.path.times, b.path.times) and np.array_equal(a.path.vectors, b.path.vectors)
    turns = a.path.vectors[:, 3:].any()
    return same and a.stop == b.stop and not (turns and (a.path.center != b.path.center).any())


def _warn_of_overruled(reach: Reach, pinned: int, prescribed: int) -> None:
    """Warn that some of an anchor's nodes are pinned, or led another way by earlier anchors; raise if all are."""
    why = [f"{pinned} {'is' if pinned == 1 else 'are'} pinned"] if pinned else []
    why += [f"{prescribed} {'is' if prescribed == 1 else 'are'} led by an anchor before it"] if prescribed else []
    if not why:
        return
    text = f"{reach.key}: of the {_nodes(reach.nodes)} in its region {' and '.join(why)}"
    if pinned + prescribed == reach.nodes:
        raise InputError(f"{text}: it leads none")
    log.warning("%s, which it does not lead", text)


def _held_while(force: Force, pinned: Mask, anchors: list[Anchor]) -> Mask:
    """Return the nodes (l,) bool that are not free at any time at which the force acts."""
    until = math.inf if force.stop is None else force.stop
    lasting = [a.where for a in anchors if a.stop is None or a.stop >= until]
    return reduce(np.logical_or, lasting, pinned)


def _warn_of_idle_parts(comm: MPI.Comm, scene: Scene, lattice: Lattice, anchors: list[Anchor], finder: Finder) -> None:
    """Warn of parts all of whose nodes are held for good, and of those that later parts have replaced (collective)."""
    parts = list(scene.tables("part"))
    if not parts:
        return
    own = lattice.local_cells[: lattice.cells_owned]
    ijk = finder.cages.grids.nearest_nodes(lattice.nodes[own[:, 0]], lattice.body[own[:, 0]])
    held = reduce(np.logical_or, (a.where for a in anchors if a.stop is None), lattice.pinned)
    free = ~held[own].all(axis=1)
    replaced = {name: np.zeros(len(own), bool) for name in ("density", "young_modulus", "stiffness")}
    for part in reversed(parts):
        where = finder.find_cells(part, ijk)
        given = [name for name in replaced if getattr(part.table, name) is not None]
        counts = where, where & ~np.all([replaced[name] for name in given], axis=0), where & free
        cells, kept, moving = comm.allreduce(np.array([mask.sum() for mask in counts]))
        if kept == 0:
            log.warning("%s has no effect: later parts give all that it gives, on all its %d cells", part.key, cells)
        elif moving == 0:
            log.warning("%s has no effect: pins and anchors hold all nodes of its %d cells", part.key, cells)
        for name in given:
            replaced[name] |= where


def _note_what_never_acts(scene: Scene) -> None:
    """Warn of forces and obstacles that are there at the end of no step."""
    time = scene.time
    forces = ((force.key, force.table) for force in scene.tables("force"))
    obstacles = ((f"obstacle.{number}", obstacle) for number, obstacle in enumerate(scene.obstacle))
    for key, table in chain(forces, obstacles):
        if _acts_in_a_step(table, time):
            continue
        until = "on" if table.stop is None else f"to {table.stop:g} s"
        text = f"{key} acts in no step: it is there from {table.start:g} s {until}"
        if table.start > time.duration:  # as --frames has it, too
            log.info("%s, and the run ends at %g s", text, time.duration)
        else:
            log.warning("%s, between the ends of steps of %g s", text, time.step)


def _acts_in_a_step(table: Force | ObstacleTable, time: Time) -> bool:
    """Return whether a table acts at the end of a step; or, where steps have substeps, at any time of the run."""
    if time.integrator == "verlet":
        return table.start < time.duration and (table.stop is None or table.stop > 0)
    first = max(1, math.ceil(table.start / time.step * (1 - SAME)))
    return first <= time.steps and within(first * time.step, table.start, table.stop)


def _nodes(count: int) -> str:
    return f"{count} node{'s' * (count != 1)}"
