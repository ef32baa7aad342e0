"""A model's arrays to where a run computes: those that each step works with. What only prepares steps stays."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from msmpetsc.model.build import Model
from msmpetsc.model.contact.obstacle import Obstacle
from msmpetsc.model.lattice import Lattice

Send = Callable[[np.ndarray], np.ndarray]


def placed(model: Model, send: Send) -> Model:
    """The model with its arrays sent where ``send`` takes them."""

    def solid(obstacle: Obstacle) -> Obstacle:
        return replace(obstacle, points=send(obstacle.points), normals=send(obstacle.normals))

    positions, velocities = model.start
    return replace(
        model,
        lattice=_lattice(model.lattice, send),
        loads=[replace(load, force=send(load.force)) for load in model.loads],
        anchors=[replace(anchor, where=send(anchor.where)) for anchor in model.anchors],
        reflections=[replace(one, obstacle=solid(one.obstacle)) for one in model.reflections],
        penalties=[replace(one, obstacle=solid(one.obstacle)) for one in model.penalties],
        start=(send(positions), send(velocities)),
    )


def _lattice(lattice: Lattice, send: Send) -> Lattice:
    names = ("nodes", "mass", "pinned", "local_cells")
    return replace(lattice, **{name: send(getattr(lattice, name)) for name in names})
