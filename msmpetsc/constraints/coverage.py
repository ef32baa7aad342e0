"""The nodes that anchors and forces take, and which of them do nothing or not what they say.

What could not have any effect at all is refused; what is overruled in part is warned of.
"""

import math
from collections.abc import Mapping
from functools import reduce

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Mask
from msmpetsc.comm import log
from msmpetsc.constraints.loads import Anchor
from msmpetsc.errors import InputError
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.scene.motion import Force
from msmpetsc.scene.reading import Scene

Regions = Mapping[str, Mask]  # the table's key in the scene, "pin.0" -> its local nodes (l,) bool


def taken(comm: MPI.Comm, scene: Scene, lattice: Lattice, anchors: list[Anchor], masks: Regions) -> tuple[str, ...]:
    """Return what anchors and forces take, in words; warn of what is overruled (collective).

    lattice : with its pins
    anchors : each with the nodes that it leads, those of its region aside that a pin or an earlier anchor has
    Raises InputError on all ranks for an anchor or a force that does nothing.
    """

    def count(where: Mask) -> int:
        return int(comm.allreduce(int(where[: lattice.owned].sum())))

    words = []
    pinned = lattice.pinned
    for table, anchor in zip(scene.tables("anchor"), anchors, strict=True):
        where = masks[table.key]
        _warn_of_overruled(table.key, count(where), count(where & pinned), count(where & ~anchor.where & ~pinned))
        words.append(f"{table.key} leads {count(anchor.where)} nodes")
    for table in scene.tables("force"):
        where, force = masks[table.key], table.table
        nodes, held = count(where), count(where & _held_while(force, pinned, anchors))
        if held == nodes and force.pulls:
            raise InputError(
                f"{table.key} moves nothing: of the {_nodes(nodes)} in its region none is free while it "
                "acts, pins and anchors hold all"
            )
        words.append(f"{table.key} pulls {nodes} nodes" + f" ({held} of them held)" * bool(held))
    return tuple(words)


def _warn_of_overruled(key: str, nodes: int, pinned: int, prescribed: int) -> None:
    """Warn of an anchor's nodes that are pinned, or led by earlier anchors; raise if all are."""
    if not pinned + prescribed:
        return
    text = f"{key}: of the {_nodes(nodes)} in its region pins hold {pinned}, and anchors before it lead {prescribed}"
    if pinned + prescribed == nodes:
        raise InputError(f"{text}: it leads none")
    log.warning("%s, which it does not lead", text)


def _held_while(force: Force, pinned: Mask, anchors: list[Anchor]) -> Mask:
    """Return the nodes (l,) bool that are not free at any time at which the force acts."""
    until = math.inf if force.stop is None else force.stop
    lasting = [a.where for a in anchors if a.stop is None or a.stop >= until]
    return reduce(np.logical_or, lasting, pinned)


def _nodes(count: int) -> str:
    return f"{count} node{'s' * (count != 1)}"
