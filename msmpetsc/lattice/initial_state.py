"""Initial state of bodies: positions and velocities of their nodes at time 0."""

from collections.abc import Callable, Sequence

import numpy as np
from mpi4py import MPI
from scipy.spatial.transform import Rotation

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.scene.motion import Start, Twist

# positions (l, 3) [m] and velocities (l, 3) [m/s], ghosts included
InitialState = tuple[Positions, Rows]
# function that returns the last state in a result file (results.checkpoint_reader)
ReadState = Callable[[str, Lattice], InitialState]


def initial_state(
    comm: MPI.Comm,
    starts: Sequence[Start | None],
    lattice: Lattice,
    fixed: Mask,
    bounds: Rows,
    read_state: ReadState | None = None,
) -> InitialState:
    """Return initial positions and velocities of nodes from their bodies' starts (collective).

    starts : the start of each body; None for a body at rest
    fixed  : (l, 3) bool, components of pins and anchors: without velocity, at their rest positions;
             components of pins keep the positions of ``start.from`` instead
    bounds : (b, 2, 3) bounding box of each body at rest [m]
    """
    states = {}
    for name in dict.fromkeys(start.from_ for start in starts if start and start.from_):
        assert read_state is not None
        states[name] = read_state(name, lattice)
    velocity = np.zeros_like(lattice.nodes)
    if not any(starts):
        return lattice.nodes, velocity
    q, body = lattice.nodes.copy(), lattice.body
    for number, start in enumerate(starts):
        if start is not None:
            own = np.flatnonzero(body == number)
            owned = int((own < lattice.owned).sum())
            q[own] = moved(start, lattice.nodes[own], lattice.global_numbers[own], bounds[number])
            at_rest = fixed[own]
            if start.from_ is not None:
                q[own], velocity[own] = (rows[own] for rows in states[start.from_])
                at_rest = fixed[own] & ~lattice.fixed[own]
            q[own] = np.where(at_rest, lattice.nodes[own], q[own])
            mass = lattice.mass[own[:owned]]
            total: Floats = comm.allreduce(np.append(mass @ q[own[:owned]], mass.sum()))
            about = total[:3] / total[3] if start.about is None else np.array(start.about)
            velocity[own] += velocity_field(start, q[own] - about)
    velocity[fixed] = 0
    return q, velocity


def velocity_field(start: Start, r: Rows) -> Rows:
    """Return the velocities (n, 3) [m/s] of a start at r (n, 3) [m], relative to ``about``."""
    velocity: Rows = np.array(start.velocity) + np.cross(start.spin, r)
    if start.gradient is not None:
        velocity += r @ np.array(start.gradient).T
    if start.swirl is not None:
        a = np.array(start.swirl.axis)
        rate = np.interp(r @ a, start.swirl.distances, start.swirl.rates)
        velocity += rate[:, None] * np.cross(a, r)
    return velocity


def moved(start: Start, nodes: Positions, numbers: Indices, bounds: Rows) -> Positions:
    """Return the initial positions (n, 3) [m] of a body's nodes, scaled, twisted and scattered.

    nodes   : (n, 3) rest positions [m]
    numbers : (n,) global numbers, which seed the scatter
    bounds  : (2, 3) bounding box of the body at rest [m]
    """
    middle = bounds.mean(axis=0)
    q: Positions = middle + np.array(start.scale) * (nodes - middle)
    if start.twist is not None:
        q = twisted(q, start.twist, nodes, bounds)
    if start.scatter > 0:
        anywhere = bounds[0] + uniform(numbers) * (bounds[1] - bounds[0])
        q = (1 - start.scatter) * q + start.scatter * anywhere
    return q


def twisted(q: Positions, twist: Twist, nodes: Positions, bounds: Rows) -> Positions:
    """Return q (n, 3) [m] twisted about the axis through the centre of the bounds.

    The angle grows linearly along the axis with the rest positions ``nodes`` (n, 3). It is 0 at the
    beginning of the bounds and ``twist.degrees`` at their end.
    """
    a = np.array(twist.axis)
    middle = bounds.mean(axis=0)
    extent = np.abs(a) @ (bounds[1] - bounds[0])
    angle = np.radians(twist.degrees) * ((nodes - middle) @ a / extent + 0.5)[:, None]
    turned: Positions = middle + Rotation.from_rotvec(angle * a).apply(q - middle)
    return turned


def uniform(numbers: Indices) -> Rows:
    """Return random numbers (n, 3) in [0, 1) that depend on the global node numbers (n,) alone.

    Component c of node n is number 3 n + c of SplitMix64 (Steele, Lea and Flood 2014).
    """
    z = (3 * numbers[:, None] + np.arange(1, 4)).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return ((z ^ (z >> np.uint64(31))) >> np.uint64(11)) * 2.0**-53
