"""Impact of nodes on obstacles, with a coefficient of restitution e.

The state has q_n and q_(n-1) in place of a velocity. There are two laws:

- ``Penalty.struck`` scales the normal velocity of a striking node by e through a new q_(n-1). The
  node's position stays, so no energy is added. The penalty force then reverses the velocity. In
  explicit steps the depth is scaled by e, too.
- ``Exchange`` is the paper's reflection (section 5): v_(n+1) = -v_n by q_(n+1) = q_(n-1). It moves
  nodes against their springs and thereby adds energy, so it is not conservative.
"""

from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Indices, Positions, Rows, like
from msmpetsc.contact.obstacles.moving_solid import Obstacle


@dataclass(frozen=True)
class StepTaken:
    """A completed step: the time [s] of its end, its length [s], and the sides of nodes.

    sides    : (n,) faces by which nodes are in contact (Obstacle.sides), or (o, n) for several
               obstacles; None without contact
    explicit : whether the step has not resolved the penalty: a node may end deep in an obstacle
    """

    time: float
    length: float
    sides: Indices | None = None
    explicit: bool = False


@dataclass(frozen=True)
class Exchange:
    """The paper's reflection, with a coefficient of restitution in [0, 1]; the paper has 1."""

    obstacle: Obstacle
    restitution: float

    def struck(
        self, q: Positions, q_previous: Positions, step: StepTaken
    ) -> tuple[Positions, Positions]:
        """Return q_n and q_(n-1) (n, 3) [m] after the impact.

        A node strikes if it is on or behind a face and v_n = q_n - q_(n-1), relative to the
        obstacle, points into the solid. The normal part of v_n is then subtracted from q_n, and the
        new v_n has -e times this part. If e = 1 and the obstacle rests, this exchanges the normal
        parts of q_n and q_(n-1).
        """
        rows, into, _ = striking(self.obstacle, q, q_previous, step)
        if len(rows) == 0:
            return q, q_previous
        q, q_previous = q.copy(), q_previous.copy()
        q[rows] -= into
        q_previous[rows] += self.restitution * into
        return q, q_previous


def striking(
    obstacle: Obstacle, q: Positions, q_previous: Positions, step: StepTaken
) -> tuple[Indices, Rows, Rows]:
    """Return nodes (k,) on or behind a face, their displacements into the solid, and the ways out.

    The displacement (k, 3) [m] is the normal part, inwards, of the step's displacement relative to
    the obstacle. The way out (k, 3) [m] leads to the face. If the obstacle does not act, the result
    is empty.
    """
    time, path = step.time, obstacle.path
    if not obstacle.acts_at(time):
        return np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3))
    inside, face = obstacle.depths(q, time, step.sides)
    behind = inside >= 0
    if step.sides is not None and obstacle.solid.has_sides:
        behind &= step.sides > 0
    rows = np.flatnonzero(behind)
    normal = obstacle.normals_at(q[rows], time, face[rows])
    v = q[rows] - q_previous[rows]
    if path.is_moving:
        v = v - like(v, path.displacement_between(time - step.length, time))
    into = np.minimum((v * normal).sum(axis=1), 0)[:, None] * normal
    return rows, into, inside[rows, None] * normal
