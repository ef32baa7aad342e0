"""Contact as the paper has it (section 5): a node that has reached an obstacle gets its velocity reversed.

There is no velocity in the state, only q_n and q_(n-1); so the paper sets v_(n+1) = -v_n by
q_(n+1) = q_(n-1): the two are exchanged. The obstacle thereby moves nodes against their springs, which
adds energy during the impact; it is not a conservative contact.
"""

from dataclasses import dataclass

import numpy as np

from msmpetsc.model.obstacle import Obstacle, depths
from msmpetsc.place.arrays import beside


@dataclass(frozen=True)
class Reflection:
    """An obstacle and its restitution in [0, 1] (1: the paper)."""

    obstacle: Obstacle
    restitution: float

    def reflect(
        self, q: np.ndarray, q_previous: np.ndarray, time: float, time_step: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """q_n and q_(n-1) after contact at ``time`` [s], that of q_n; (n, 3) [m] each.

        Where a node of q lies on or in the obstacle and its v_n = q_n - q_(n-1), as seen from the obstacle,
        goes on into it, the normal part of q_n goes back by that of v_n, which becomes -e times itself.
        With e = 1 and an obstacle at rest this exchanges the normal parts of q_n and q_(n-1).
        """
        if not self.obstacle.acts_at(time):
            return q, q_previous
        inside, face = depths(q, self.obstacle.points_at(time), self.obstacle.normals)
        at = np.flatnonzero(inside >= 0)
        if len(at) == 0:
            return q, q_previous
        normal, path = self.obstacle.normals[face[at]], self.obstacle.path
        v = q[at] - q_previous[at]
        if path.leads_away:
            v -= beside(q, path.at(time) - path.at(time - time_step))
        back = np.minimum((v * normal).sum(axis=1), 0)[:, None] * normal
        q, q_previous = q.copy(), q_previous.copy()
        q[at] -= back
        q_previous[at] += self.restitution * back
        return q, q_previous
