"""State of bodies at time 0: positions and velocities of their nodes."""

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI
from scipy.spatial.transform import Rotation

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.scene.motion import Start, Twist

InitialState = tuple[
    Positions, Rows
]  # positions (l, 3) [m] and velocities (l, 3) [m/s], ghosts included


def initial_state(
    comm: MPI.Comm, starts: Sequence[Start | None], lattice: Lattice, held: Mask, bounds: Rows
) -> InitialState:
    """Return positions and velocities of nodes by the starts of their bodies (collective).

    starts : of each body; None: at rest
    held   : (l,) bool, nodes that stay at rest where they are
    bounds : (b, 2, 3) each body's bounding box at rest [m]
    """
    velocity = np.zeros_like(lattice.nodes)
    if not any(starts):
        return lattice.nodes, velocity
    q, body = lattice.nodes.copy(), lattice.body
    for number, start in enumerate(starts):
        if start is not None:
            own = np.flatnonzero(body == number)
            owned = int((own < lattice.owned).sum())
            q[own] = moved(start, lattice.nodes[own], lattice.global_numbers[own], bounds[number])
            q[own[held[own]]] = lattice.nodes[own[held[own]]]
            mass = lattice.mass[own[:owned]]
            total: Floats = comm.allreduce(np.append(mass @ q[own[:owned]], mass.sum()))
            middle = total[:3] / total[3]  # the centre of mass
            velocity[own] = np.array(start.velocity) + np.cross(start.spin, q[own] - middle)
    velocity[held] = 0
    return q, velocity


def moved(start: Start, nodes: Positions, numbers: Indices, bounds: Rows) -> Positions:
    """Return the initial positions (n, 3) [m] of a body's nodes, by their global numbers (n,)."""
    middle = bounds.mean(axis=0)
    q: Positions = middle + np.array(start.scale) * (nodes - middle)
    if start.twist is not None:
        q = twisted(q, start.twist, nodes, bounds)
    if start.scatter > 0:
        anywhere = bounds[0] + uniform(numbers) * (bounds[1] - bounds[0])
        q = (1 - start.scatter) * q + start.scatter * anywhere
    return q


def twisted(q: Positions, twist: Twist, nodes: Positions, bounds: Rows) -> Positions:
    """Return q (n, 3) [m] turned about the axis through the middle of the bounds.

    The angle grows along the axis with the ``nodes`` (n, 3) at rest: none where the bounds begin,
    all degrees where they end.
    """
    a, middle = np.array(twist.axis) / np.linalg.norm(twist.axis), bounds.mean(axis=0)
    extent = np.abs(a) @ (bounds[1] - bounds[0])
    angle = np.radians(twist.degrees) * ((nodes - middle) @ a / extent + 0.5)[:, None]
    turned: Positions = middle + Rotation.from_rotvec(angle * a).apply(q - middle)
    return turned


def uniform(numbers: Indices) -> Rows:
    """Return three random numbers in [0, 1) for each global node number (n,), (n, 3), whatever ranks there are.

    SplitMix64 (Steele, Lea and Flood 2014), its number 3 n + c.
    """
    z = (3 * numbers[:, None] + np.arange(1, 4)).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return ((z ^ (z >> np.uint64(31))) >> np.uint64(11)) * 2.0**-53
