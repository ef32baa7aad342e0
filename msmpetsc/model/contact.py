"""Contact as the paper has it (section 5): a node that has reached a plane gets its velocity reversed.

There is no velocity in the state, only q_n and q_(n-1); so the paper sets v_(n+1) = -v_n by
q_(n+1) = q_(n-1): the two are exchanged. The plane thereby moves nodes against their springs, which
adds energy during the impact; it is not a conservative contact.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Plane:
    """point (3,) [m], unit normal (3,) towards the free side, restitution in [0, 1] (1: the paper)."""

    point: np.ndarray
    normal: np.ndarray
    restitution: float

    def reflect(self, q: np.ndarray, q_previous: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """q_n and q_(n-1) after contact, (n, 3) [m] each.

        Where a node of q lies on or behind the plane and its v_n = q_n - q_(n-1) goes on into it, the
        normal part of q_n goes back to that of q_(n-1), and the normal part of v_n becomes -e times itself.
        With e = 1 this exchanges the normal parts.
        """
        into = (q - q_previous) @ self.normal
        hit = ((q - self.point) @ self.normal <= 0) & (into < 0)
        back = np.where(hit, into, 0)[:, None] * self.normal
        return q - back, q_previous + self.restitution * back
