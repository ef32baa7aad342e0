"""Contact as the paper has it (section 5): a node that has reached an obstacle gets its velocity reversed.

There is no velocity in the state, only q_n and q_(n-1); so the paper sets v_(n+1) = -v_n by
q_(n+1) = q_(n-1): the two are exchanged. The obstacle thereby moves nodes against their springs, which
adds energy during the impact; it is not a conservative contact. BDF2, which loses next to none, turns
velocities round where nodes are (``turn``).
"""

from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import like
from msmpetsc.model.contact.obstacle import Obstacle


@dataclass(frozen=True)
class Reflection:
    """An obstacle and its restitution in [0, 1] (1: the paper)."""

    obstacle: Obstacle
    restitution: float

    def reflect(
        self,
        q: np.ndarray,
        q_previous: np.ndarray,
        time: float,
        time_step: float,
        sides: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return q_n and q_(n-1) after contact at ``time`` [s], that of q_n; (n, 3) [m] each.

        Where a node, on its way, has come to lie on or behind a face and its v_n = q_n - q_(n-1), as seen from
        the obstacle, goes on into it, the normal part of q_n goes back by that of v_n, which becomes -e times itself.
        With e = 1 and an obstacle at rest this exchanges the normal parts of q_n and q_(n-1).

        sides : (n,) by which faces nodes are in contact (Obstacle.sides), of a box; by default as the way from q_(n-1)
            tells
        """
        if not self.obstacle.acts_at(time):
            return q, q_previous
        if sides is None and self.obstacle.has_sides:
            sides = self.obstacle.sides(q_previous, q, time, time_step)
        rows, normal = self._behind(q, time, sides)
        if len(rows) == 0:
            return q, q_previous
        back = np.minimum(self._speed(q[rows] - q_previous[rows], normal, time, time_step), 0)[:, None] * normal
        q, q_previous = q.copy(), q_previous.copy()
        q[rows] -= back
        q_previous[rows] += self.restitution * back
        return q, q_previous

    def turn(
        self,
        q: np.ndarray,
        q_previous: np.ndarray,
        a: np.ndarray,
        time: float,
        time_step: float,
        sides: np.ndarray,
    ) -> np.ndarray:
        """Return q_(n-1) (n, 3) [m] so that velocities are reversed but nodes stay where they are.

        They are behind the face until they have gone back through it: no spring is stretched, no energy comes in.

        a : (n, 3) [m] acceleration times t^2. Where that presses a node on, half of it is the least way back in a step,
            or the node would sink in with e < 1; but no node leaves faster than it came.
        """
        if not self.obstacle.acts_at(time):
            return q_previous
        rows, normal = self._behind(q, time, sides)
        if len(rows) == 0:
            return q_previous
        speed = np.minimum(self._speed(q[rows] - q_previous[rows], normal, time, time_step), 0)
        least = np.maximum(-0.5 * (a[rows] * normal).sum(axis=1), 0)
        away = np.minimum(-speed, np.maximum(-self.restitution * speed, least))
        q_previous = q_previous.copy()
        q_previous[rows] += (speed - away)[:, None] * normal
        return q_previous

    def _behind(self, q: np.ndarray, time: float, sides: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodes (k,) on or behind the faces of their ``sides``, and these faces' normals (k, 3)."""
        obstacle = self.obstacle
        inside, face = obstacle.depths(q, time, sides)
        behind = inside >= 0
        if sides is not None and obstacle.has_sides:
            behind &= sides > 0
        rows = np.flatnonzero(behind)
        return rows, obstacle.normals_at(q[rows], time, face[rows])

    def _speed(self, v: np.ndarray, normal: np.ndarray, time: float, time_step: float) -> np.ndarray:
        """Return the part along the normals of displacements v (k, 3) [m] in a step, (k,) [m].

        They are as seen from the obstacle.
        """
        path = self.obstacle.path
        if path.leads_away:
            v = v - like(v, path.at(time) - path.at(time - time_step))
        return (v * normal).sum(axis=1)
