"""What a node does that strikes an obstacle: it loses speed (``slowed``), or, as the paper has it
(section 5), its last two positions are exchanged (``Exchange``).

There is no velocity in the state, only q_n and q_(n-1). A node that strikes gets e times its normal
velocity by another q_(n-1): it stays where the springs want it, and no energy comes in. The push of
the face then turns it round, so that it leaves with e times the speed that it came with.

The paper reverses a velocity, v_(n+1) = -v_n, by q_(n+1) = q_(n-1). The obstacle thereby moves
nodes against their springs, which adds energy during the impact; it is not a conservative contact.
"""

from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Indices, Positions, Rows, like
from msmpetsc.contact.obstacles.moving_solid import Obstacle


@dataclass(frozen=True)
class StepTaken:
    """The time [s] that a step ended at, its length [s], and by which faces (n,) nodes are in
    contact (Obstacle.sides), of several obstacles (o, n); None: by none."""

    time: float
    length: float
    sides: Indices | None = None


@dataclass(frozen=True)
class Exchange:
    """An obstacle and its restitution in [0, 1] (1: the paper)."""

    obstacle: Obstacle
    restitution: float

    def exchanged(
        self, q: Positions, q_previous: Positions, step: StepTaken
    ) -> tuple[Positions, Positions]:
        """Return q_n and q_(n-1) after contact; (n, 3) [m] each.

        Where a node, on its way, has come to lie on or behind a face and its v_n = q_n - q_(n-1), as seen from
        the obstacle, goes on into it, the normal part of q_n goes back by that of v_n, which becomes -e times itself.
        With e = 1 and an obstacle at rest this exchanges the normal parts of q_n and q_(n-1).
        """
        rows, into = striking(self.obstacle, q, q_previous, step)
        if len(rows) == 0:
            return q, q_previous
        q, q_previous = q.copy(), q_previous.copy()
        q[rows] -= into
        q_previous[rows] += self.restitution * into
        return q, q_previous


def slowed(
    obstacle: Obstacle, restitution: float, q: Positions, q_previous: Positions, step: StepTaken
) -> Positions:
    """Return q_(n-1) (n, 3) [m] by which nodes that came to a face in this step have e times their velocity into it."""
    rows, into = striking(obstacle, q, q_previous, step)
    before = obstacle.depths(q_previous, step.time - step.length, step.sides)[0][rows]
    rows, into = rows[before < 0], into[before < 0]
    if len(rows) == 0:
        return q_previous
    q_previous = q_previous.copy()
    q_previous[rows] += (1 - restitution) * into
    return q_previous


def striking(
    obstacle: Obstacle, q: Positions, q_previous: Positions, step: StepTaken
) -> tuple[Indices, Rows]:
    """Return the nodes (k,) on or behind the faces of their sides, and the part (k, 3) [m] of their way in the step
    that goes on into it, as seen from the obstacle; nothing where that is not there."""
    time, path = step.time, obstacle.path
    if not obstacle.acts_at(time):
        return np.zeros(0, np.int64), np.zeros((0, 3))
    inside, face = obstacle.depths(q, time, step.sides)
    behind = inside >= 0
    if step.sides is not None and obstacle.solid.has_sides:
        behind &= step.sides > 0
    rows = np.flatnonzero(behind)
    normal = obstacle.normals_at(q[rows], time, face[rows])
    v = q[rows] - q_previous[rows]
    if path.leads_away:
        v = v - like(v, path.displacement_between(time - step.length, time))
    return rows, np.minimum((v * normal).sum(axis=1), 0)[:, None] * normal
