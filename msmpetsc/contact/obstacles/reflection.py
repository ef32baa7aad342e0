"""Change of velocity of nodes that strike an obstacle.

A state has no velocity, only q_n and q_(n-1).

- ``slowed`` changes q_(n-1), so that the normal velocity becomes e times itself. The node stays in
  place, and no energy comes in. The penalty of the face then turns the node round, so that it
  leaves with e times its speed.
- ``Exchange`` reverses a velocity, v_(n+1) = -v_n, by q_(n+1) = q_(n-1) (paper section 5). The
  obstacle thereby moves nodes against their springs, which adds energy: the contact is not
  conservative.
"""

from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Indices, Positions, Rows, like
from msmpetsc.contact.obstacles.moving_solid import Obstacle


@dataclass(frozen=True)
class StepTaken:
    """Step that has been taken.

    time   : of its end [s]
    length : [s]
    sides  : (n,) faces by which nodes are in contact (Obstacle.sides), (o, n) of several
             obstacles; None without contact
    """

    time: float
    length: float
    sides: Indices | None = None


@dataclass(frozen=True)
class Exchange:
    """Obstacle with a restitution in [0, 1], 1 in the paper."""

    obstacle: Obstacle
    restitution: float

    def exchanged(
        self, q: Positions, q_previous: Positions, step: StepTaken
    ) -> tuple[Positions, Positions]:
        """Return q_n and q_(n-1) after contact, (n, 3) [m] each.

        A node strikes if it lies on or behind a face and its v_n = q_n - q_(n-1), relative to the
        obstacle, leads further in. The normal part of q_n then goes back by that of v_n, which
        becomes -e times itself. With e = 1 and an obstacle at rest this exchanges the normal parts
        of q_n and q_(n-1).
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
    """Return q_(n-1) (n, 3) [m] such that striking nodes have e times their normal velocity."""
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
    """Return the nodes (k,) on or behind faces, and their inward displacements (k, 3) [m].

    Displacements are those of the step, relative to the obstacle and normal to the face. There are
    no nodes if the obstacle does not act.
    """
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
