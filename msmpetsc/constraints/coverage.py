"""The nodes that pins, anchors and forces of a scene reach, and which of them do nothing or not what they say.

What could not have any effect at all is refused; what is overruled in part is warned of.
"""

import math
from collections.abc import Mapping
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


def regions(scene: Scene, lattice: Lattice, finder: Finder, points: Positions) -> dict[str, Mask]:
    """Return the nodes of each pin, anchor and force (collective). Raises InputError for a region without nodes.

    points : (l, 3) of the bodies that nodes are nearest to [m]
    """
    tables = chain.from_iterable(scene.tables(kind) for kind in NODES)
    return {table.key: finder.find(table, lattice, points) for table in tables}


def taken(comm: MPI.Comm, scene: Scene, lattice: Lattice, anchors: list[Anchor], masks: Regions) -> tuple[str, ...]:
    """Return what each anchor and force of a scene takes, in words; warn of what is overruled (collective).

    lattice : with its pins
    anchors : each with the nodes that it leads, those of its region aside that a pin or an earlier anchor has
    Raises InputError on all ranks for an anchor or a force that does nothing.
    """

    def count(where: Mask) -> int:
        return int(comm.allreduce(int(where[: lattice.owned].sum())))

    words, pinned = [], lattice.pinned
    for number, (table, anchor) in enumerate(zip(scene.tables("anchor"), anchors, strict=True)):
        where = masks[table.key]
        same = (before.where for before in anchors[:number] if _leads_alike(before, anchor))
        alike = reduce(np.logical_or, same, np.zeros_like(pinned))
        prescribed = count(where & ~anchor.where & ~pinned & ~alike)
        _warn_of_overruled(table.key, count(where), count(where & pinned), prescribed)
        words.append(f"{table.key} leads {count(anchor.where)} nodes")
    for table in scene.tables("force"):
        where, force = masks[table.key], table.table
        nodes, held = count(where), count(where & _held_while(force, pinned, anchors))
        if held == nodes and force.pulls:
            raise InputError(
                f"{table.key} moves nothing: of the {_nodes(nodes)} in its region none is free while it "
                "acts, pins and anchors hold all"
            )
        words.append(f"{table.key} pulls {nodes} nodes" + (f" ({held} of them held)" if held else ""))
    _note_what_never_acts(scene)
    return tuple(words)


def _leads_alike(a: Anchor, b: Anchor) -> bool:
    """Return whether it does not matter which of two anchors has a node: path, center and stop are the same."""
    same = np.array_equal(a.path.times, b.path.times) and np.array_equal(a.path.vectors, b.path.vectors)
    turns = a.path.vectors[:, 3:].any()
    return same and a.stop == b.stop and not (turns and (a.path.center != b.path.center).any())


def _warn_of_overruled(key: str, nodes: int, pinned: int, prescribed: int) -> None:
    """Warn that some of an anchor's nodes are pinned, or led another way by earlier anchors; raise if all are."""
    why = [f"{pinned} {'is' if pinned == 1 else 'are'} pinned"] if pinned else []
    why += [f"{prescribed} {'is' if prescribed == 1 else 'are'} led by an anchor before it"] if prescribed else []
    if not why:
        return
    text = f"{key}: of the {_nodes(nodes)} in its region {' and '.join(why)}"
    if pinned + prescribed == nodes:
        raise InputError(f"{text}: it leads none")
    log.warning("%s, which it does not lead", text)


def _held_while(force: Force, pinned: Mask, anchors: list[Anchor]) -> Mask:
    """Return the nodes (l,) bool that are not free at any time at which the force acts."""
    until = math.inf if force.stop is None else force.stop
    lasting = [a.where for a in anchors if a.stop is None or a.stop >= until]
    return reduce(np.logical_or, lasting, pinned)


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
