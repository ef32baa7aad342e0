"""What nodes stay out of: planes and boxes, balls, closed meshes, and what a function of the user's own describes.

Each at its place at time 0; where an obstacle has moved, positions are as seen from it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows
from msmpetsc.backend.kernel import kernel
from msmpetsc.contact.obstacles.faces import depth, side_of

TINY = 1e-300  # [m]

Send = Callable[[Array], Array]


class Solid(Protocol):
    """A solid. Positions are (n, 3) [m]; a face is what a node comes in by, one of several or the only one, 0."""

    @property
    def has_sides(self) -> bool:
        """Whether it matters by which of its faces a node came in: then there is a ``sides_of``, as of Faces."""
        ...

    def depths(self, q: Positions, sides: Indices | None = None) -> tuple[Floats, Indices]:
        """Return how deep positions lie (n,) [m], behind the face of their side (n or more,) or else the nearest, and
        that face (n,).

        Outside it is negative, and no less than minus the distance.
        """
        ...

    def normals(self, q: Positions, face: Indices) -> Rows:
        """Return the unit normals (n, 3) of the faces (n,) at positions within."""
        ...

    def deeper(self, q: Positions, moved: Rows, face: Indices) -> Floats:
        """Return how much deeper positions within lie behind faces (n,) than ``moved`` (n, 3) [m] before, (n,) [m].

        A difference of depths would keep only the digits of a position.
        """
        ...

    def sent(self, send: Send) -> "Solid":
        """Return it with the arrays that each step works with sent where ``send`` takes them."""
        ...


@kernel
def _depths_of(first, count, step, q, points, normals, sides, depths, face):
    for i in range(first, count, step):
        depths[i], face[i] = depth(q[i], points, normals, sides[i])


@kernel
def _sides_of(first, count, step, q, end, points, normals, before, sides):
    for i in range(first, count, step):
        sides[i] = side_of(q[i], end[i], points, normals, before[i])


@dataclass(frozen=True)
class Faces:
    """The points behind all faces: one face is a plane, six are a box.

    points, normals : (f, 3) a point of each face [m], its unit normal towards the free side
    """

    points: Positions
    normals_of_faces: Rows

    @classmethod
    def of_box(cls, low: Positions, high: Positions) -> "Faces":
        """Return the box between two corners (3,) [m]."""
        points = np.repeat(np.array([low, high], float), 3, axis=0)  # the faces that meet at each of the two corners
        return cls(points, np.concatenate([-np.eye(3), np.eye(3)]))

    @property
    def has_sides(self) -> bool:
        """Whether there are several faces."""
        return len(self.points) > 1

    def depths(self, q: Positions, sides: Indices | None = None) -> tuple[Floats, Indices]:
        """Return how deep positions lie (n,) [m], and the faces (n,) that count."""
        depths, face = np.empty(len(q), like=q), np.empty(len(q), np.int64, like=q)
        sides = no_sides(q) if sides is None else sides
        _depths_of(len(q), q, self.points, self.normals_of_faces, sides, depths, face)
        return depths, face

    def normals(self, q: Positions, face: Indices) -> Rows:
        """Return the unit normals (n, 3) of the faces (n,) at positions within."""
        return self.normals_of_faces[face]

    def deeper(self, q: Positions, moved: Rows, face: Indices) -> Floats:
        """Return how much deeper positions within lie than ``moved`` (n, 3) [m] before, (n,) [m]."""
        return -(moved * self.normals_of_faces[face]).sum(axis=1)

    def sides_of(self, q: Positions, end: Positions, before: Indices) -> Indices:
        """Return ``side_of`` (n,) of nodes that go straight from q to ``end`` (n, 3), ``before`` (n,) having sides."""
        sides = no_sides(q)
        _sides_of(len(q), q, end, self.points, self.normals_of_faces, before, sides)
        return sides

    def sent(self, send: Send) -> "Faces":
        """Return it with its arrays sent where ``send`` takes them."""
        return replace(self, points=send(self.points), normals_of_faces=send(self.normals_of_faces))


@dataclass(frozen=True)
class BallSolid:
    """A ball: center (3,) and radius [m]. At its very center there is no normal."""

    center: Positions
    radius: float
    has_sides = False

    def depths(self, q: Positions, sides: Indices | None = None) -> tuple[Floats, Indices]:
        """Return how deep positions lie (n,) [m], and the faces (n,) that count."""
        return self.radius - np.linalg.norm(q - self.center, axis=1), one_face(q)

    def normals(self, q: Positions, face: Indices) -> Rows:
        """Return the unit normals (n, 3) of the faces (n,) at positions within."""
        out = q - self.center
        return out / np.maximum(np.linalg.norm(out, axis=1), TINY)[:, None]

    def deeper(self, q: Positions, moved: Rows, face: Indices) -> Floats:
        """Return how much deeper positions within lie: |u| - |v| = (u - v) (u + v) / (|u| + |v|), (n,) [m]."""
        u = q - self.center
        v = u - moved
        both = np.linalg.norm(u, axis=1) + np.linalg.norm(v, axis=1)
        return -(moved * (u + v)).sum(axis=1) / np.maximum(both, TINY)

    def sent(self, send: Send) -> "BallSolid":
        """Return it with its arrays sent where ``send`` takes them."""
        return replace(self, center=send(self.center))


def one_face(q: Positions) -> Indices:
    """Return the faces (n,) of positions (n, 3) in a solid that has but one."""
    return np.zeros(len(q), np.int64, like=q)


def no_sides(q: Positions) -> Indices:
    """Return the sides (n,) of nodes (n, 3) that are in contact with nothing."""
    return np.zeros(len(q), np.int8, like=q)
