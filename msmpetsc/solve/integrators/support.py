"""Support of a body in statics: without inertia, what nothing holds has no equilibrium."""

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import to_host
from msmpetsc.elasticity.locate import of_body
from msmpetsc.errors import InputError
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.bodies import Bodies, bodies_of

FLAT = 1e-6  # cells: nodes no farther than that from a line are on it
WAYS = ("by nothing", "at a point, about which it turns", "along a line, about which it turns")  # by dimensions


def refuse_free_bodies(comm: MPI.Comm, unknowns: Unknowns) -> None:
    """Raise InputError where rigid motions are left to the free nodes, or to a part of them that no spring joins with
    the rest (collective).

    A part is held by the nodes at the other ends of its springs, of which three must not be on a line.
    """
    bodies = bodies_of(comm, unknowns)
    spans = _spans(comm, unknowns, bodies)
    loose = np.flatnonzero(spans < len(WAYS))
    if not len(loose):
        return
    nodes, positions, first = _nodes(comm, unknowns, bodies, int(loose[0]))
    place, whose = ", ".join(f"{x:.4g}" for x in positions), of_body(unknowns.lattice, first)
    what = "the body" if len(spans) == 1 else f"a part {whose}of {nodes} nodes about ({place}) m at rest"
    more = f", and so are {len(loose) - 1} more parts" if len(loose) > 1 else ""
    raise InputError(
        f'time.integrator = "static": {what} is held {WAYS[spans[loose[0]]]}{more}: it has no equilibrium without '
        "inertia; pin it or lead it by an anchor (contact does not count), or choose another integrator"
    )


def _spans(comm: MPI.Comm, unknowns: Unknowns, bodies: Bodies) -> np.ndarray:
    """Return of each body (b,) by what it is held: 0 nothing, 1 a point, 2 points on a line, 3 others."""
    lattice = unknowns.lattice
    springs, number = lattice.springs[: lattice.springs_owned], bodies.number
    nodes = (to_host(lattice.nodes) - _middle(comm, to_host(lattice.nodes))) / lattice.cell_size
    sums = np.zeros((len(bodies.free), 13))  # count, sum of p, sum of p p^T
    for free, held in (springs.T, springs[:, ::-1].T):
        joins = (number[free] >= 0) & (number[held] < 0)
        p = nodes[held[joins]]
        moments = np.concatenate([np.ones((len(p), 1)), p, (p[:, :, None] * p[:, None, :]).reshape(-1, 9)], axis=1)
        np.add.at(sums, number[free[joins]], moments)
    comm.Allreduce(MPI.IN_PLACE, sums, MPI.SUM)
    count, mean = sums[:, 0], sums[:, 1:4] / np.maximum(sums[:, :1], 1)
    spread = sums[:, 4:].reshape(-1, 3, 3) - count[:, None, None] * mean[:, :, None] * mean[:, None, :]
    apart = np.linalg.eigvalsh(spread)[:, 1:] > FLAT * np.maximum(count, 1)[:, None]
    return np.where(count > 0, 1 + apart.sum(axis=1), 0)


def _middle(comm: MPI.Comm, nodes: np.ndarray) -> np.ndarray:
    """Return a point (3,) [m] amid the nodes (l, 3) of all ranks."""
    sums = comm.allreduce(np.append(nodes.sum(axis=0), len(nodes)))
    return sums[:3] / sums[3]


def _nodes(comm: MPI.Comm, unknowns: Unknowns, bodies: Bodies, body: int) -> tuple[int, np.ndarray, int]:
    """Return how many nodes a body has, their mean (3,) [m] at rest, and the least of their global numbers."""
    lattice = unknowns.lattice
    rows = np.flatnonzero(bodies.number[: lattice.owned] == body)
    own = to_host(lattice.nodes[: lattice.owned])[rows]
    sums = comm.allreduce(np.append(own.sum(axis=0), len(own)))
    least = comm.allreduce(int(rows.min(initial=lattice.owned)) + lattice.table.first, MPI.MIN)
    return int(sums[3]), sums[:3] / sums[3], least
