"""Solids that nodes stay out of: planes, boxes and balls.

Each at its place at time 0; where an obstacle has moved, positions are as seen from it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows
from msmpetsc.backend.kernel import kernel, njit

TINY = 1e-300  # [m]
OPPOSITE = -1 + 1e-9  # cosine of two faces that look away from each other
ROUNDED = 1e-12  # of a node's way: a plate as thin as that is not passed either

Send = Callable[[Array], Array]


class Solid(ABC):
    """A solid. Positions are (n, 3) [m]; a face is what a node comes in by, one of several or the only one, 0."""

    @property
    def has_sides(self) -> bool:
        """Whether it matters by which of its faces a node came in."""
        return False

    @abstractmethod
    def depths(self, q: Positions, sides: Indices | None = None) -> tuple[Floats, Indices]:
        """Return how deep positions lie (n,) [m], behind the face of their side (n or more,) or
        else the nearest, and that face (n,).

        Outside it is negative, and no less than minus the distance.
        """

    @abstractmethod
    def normals(self, q: Positions, face: Indices) -> Rows:
        """Return the unit normals (n, 3) of the faces (n,) at positions within."""

    @abstractmethod
    def deeper(self, q: Positions, moved: Rows, face: Indices) -> Floats:
        """Return how much deeper positions within lie behind faces (n,) than ``moved`` (n, 3) [m] before, (n,) [m].

        A difference of depths would keep only the digits of a position.
        """

    def sent(self, send: Send) -> "Solid":
        """Return it with the arrays that each step works with sent where ``send`` takes them."""
        return self


class Planes(NamedTuple):
    """Planes of faces, (f, 3) each: a point [m], and the unit normal towards the free side."""

    points: Positions
    normals: Rows


class Depths(NamedTuple):
    """Sides (n or more,) of nodes; their depths (n,) [m] and faces (n,), to be written to."""

    sides: Indices
    depths: Floats
    faces: Indices


class Ways(NamedTuple):
    """Ends (n, 3) [m] of nodes' ways, sides (n,) before, and after (n,), to be written to."""

    ends: Positions
    before: Indices
    sides: Indices


@njit(inline="always")
def behind(q: Positions, i: int, planes: Planes, face: int) -> float:
    """Return how far the position q[i] (3,) lies behind a face [m]; negative in front of it."""
    points, normals = planes
    distance: float = -normals[face, 0] * (q[i, 0] - points[face, 0])
    distance -= normals[face, 1] * (q[i, 1] - points[face, 1])
    distance -= normals[face, 2] * (q[i, 2] - points[face, 2])
    return distance


@njit(inline="always")
def depth(q: Positions, i: int, planes: Planes, side: int) -> tuple[float, int]:
    """Return how deep q[i] (3,) lies behind the face of its ``side`` [m], and that face.

    Without a side: how deep in the solid, not positive outside, and the nearest face.
    """
    if side > 0:
        return behind(q, i, planes, side - 1), side - 1
    least, face = np.inf, 0
    for f in range(len(planes.points)):
        distance = behind(q, i, planes, f)
        if distance < least:
            least, face = distance, f
    return least, face


@njit()
def _stays(q: Positions, i: int, planes: Planes, face: int) -> bool:
    """Return whether q[i] lies behind a face and has not slid off it past another.

    The opposite face is left aside: that of a thin plate may be passed.
    """
    if behind(q, i, planes, face) <= 0.0:
        return False
    for f in range(len(planes.points)):
        along = 0.0
        for c in range(3):
            along += planes.normals[f, c] * planes.normals[face, c]
        if along > OPPOSITE and behind(q, i, planes, f) <= 0.0:
            return False
    return True


@njit()
def side_of(q: Positions, end: Positions, i: int, planes: Planes, side: int) -> int:
    """Return 1 + the face by which a node is in contact on its straight way from q[i] to end[i], 0 if it meets none.

    side : by which it was before: it keeps that until it is out of the solid

    It is the node that counts here, however far it sticks out of the surface: with a side, but no
    depth yet, it is on its way in, or out again.
    """
    if side > 0 and _stays(q, i, planes, side - 1):
        return side
    inside, face = depth(q, i, planes, 0)
    if inside > 0.0:
        return face + 1
    enter, leave, side = -1.0, 1.0, 0  # fractions of the way
    for f in range(len(planes.points)):
        first, last = behind(q, i, planes, f), behind(end, i, planes, f)
        if first <= 0.0:
            if last < 0.0 or last == first:
                return 0
            crossing = first / (first - last)
            if crossing > enter:
                enter, side = crossing, f + 1
        elif last <= 0.0:
            leave = min(leave, first / (first - last))
    return side if enter <= leave + ROUNDED else 0


@kernel
def _depths_of(first: int, count: int, step: int, q: Positions, planes: Planes, of: Depths) -> None:
    for i in range(first, count, step):
        of.depths[i], of.faces[i] = depth(q, i, planes, of.sides[i])


@kernel
def _sides_of(first: int, count: int, step: int, q: Positions, planes: Planes, ways: Ways) -> None:
    ends, before, sides = ways
    for i in range(first, count, step):
        sides[i] = side_of(q, ends, i, planes, before[i])


@dataclass(frozen=True)
class Faces(Solid):
    """The points behind all faces: one face is a plane, six are a box."""

    planes: Planes

    @classmethod
    def of_box(cls, low: Positions, high: Positions) -> "Faces":
        """Return the box between two corners (3,) [m]."""
        points = np.repeat(
            np.array([low, high], float), 3, axis=0
        )  # the faces that meet at each of the two corners
        return cls(Planes(points, np.concatenate([-np.eye(3), np.eye(3)])))

    @property
    def has_sides(self) -> bool:
        return len(self.planes.points) > 1

    def depths(self, q: Positions, sides: Indices | None = None) -> tuple[Floats, Indices]:
        sides = no_sides(q) if sides is None else sides
        of = Depths(sides, np.empty(len(q), like=q), np.empty(len(q), np.int64, like=q))
        _depths_of(len(q), q, self.planes, of)
        return of.depths, of.faces

    def normals(self, q: Positions, face: Indices) -> Rows:
        return self.planes.normals[face]

    def deeper(self, q: Positions, moved: Rows, face: Indices) -> Floats:
        deeper: Floats = -(moved * self.planes.normals[face]).sum(axis=1)
        return deeper

    def sides_of(self, q: Positions, end: Positions, before: Indices) -> Indices:
        """Return ``side_of`` (n,) of nodes that go straight from q to ``end`` (n, 3), ``before`` (n,) having sides."""
        ways = Ways(end, before, no_sides(q))
        _sides_of(len(q), q, self.planes, ways)
        return ways.sides

    def sent(self, send: Send) -> "Faces":
        return Faces(Planes(*map(send, self.planes)))


@dataclass(frozen=True)
class BallSolid(Solid):
    """A ball: center (3,) and radius [m]. At its very center there is no normal."""

    center: Positions
    radius: float

    def depths(self, q: Positions, sides: Indices | None = None) -> tuple[Floats, Indices]:
        return self.radius - np.linalg.norm(q - self.center, axis=1), np.zeros(
            len(q), np.int64, like=q
        )

    def normals(self, q: Positions, face: Indices) -> Rows:
        out = q - self.center
        normals: Rows = out / np.maximum(np.linalg.norm(out, axis=1), TINY)[:, None]
        return normals

    def deeper(self, q: Positions, moved: Rows, face: Indices) -> Floats:
        """Return how much deeper positions within lie: |u| - |v| = (u - v) (u + v) / (|u| + |v|), (n,) [m]."""
        u = q - self.center
        v = u - moved
        both = np.linalg.norm(u, axis=1) + np.linalg.norm(v, axis=1)
        deeper: Floats = -(moved * (u + v)).sum(axis=1) / np.maximum(both, TINY)
        return deeper

    def sent(self, send: Send) -> "BallSolid":
        return replace(self, center=send(self.center))


def no_sides(q: Positions) -> Indices:
    """Return the sides (n,) of nodes (n, 3) that are in contact with nothing."""
    return np.zeros(len(q), np.int8, like=q)
