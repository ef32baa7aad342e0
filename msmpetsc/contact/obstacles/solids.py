"""Solids that nodes stay out of: planes, boxes and balls.

A solid is at its place at time 0. Positions are relative to a moved obstacle.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows
from msmpetsc.backend.kernel import kernel, njit

# Least length [m], against division by 0
TINY = 1e-300
# Cosine below which two faces look away from each other
OPPOSITE = -1 + 1e-9
# Share of a node's way; a thinner plate is not passed either
ROUNDED = 1e-12

Send = Callable[[Array], Array]


class Solid(ABC):
    """Solid with one or more faces, numbered from 0. Positions are (n, 3) [m]."""

    @property
    def has_sides(self) -> bool:
        """Whether the face through which a node entered matters."""
        return False

    @abstractmethod
    def depths(self, q: Positions, sides: Indices | None = None) -> tuple[Floats, Indices]:
        """Return depths (n,) [m] behind the face of each side, or else the nearest, and faces (n,).

        A depth outside is negative, and no less than minus the distance.

        sides : (n or more,) of the positions
        """

    @abstractmethod
    def normals(self, q: Positions, face: Indices) -> Rows:
        """Return the unit normals (n, 3) of faces (n,) at inner positions."""

    @abstractmethod
    def deeper(self, q: Positions, moved: Rows, face: Indices) -> Floats:
        """Return the change of depth (n,) [m] behind faces (n,) over displacements ``moved`` (n,
        3).

        A difference of depths would have only the digits of a position.
        """

    def sent(self, send: Send) -> "Solid":
        """Return the solid with the arrays of a step moved by ``send``, to a device."""
        return self


class Planes(NamedTuple):
    """Planes of faces: points (f, 3) [m] and unit normals (f, 3) towards the free side."""

    points: Positions
    normals: Rows


class Depths(NamedTuple):
    """Sides (n or more,) of nodes, and depths (n,) [m] and faces (n,) as output."""

    sides: Indices
    depths: Floats
    faces: Indices


class Ways(NamedTuple):
    """Ends (n, 3) [m] of nodes' ways, sides (n,) before, and sides (n,) after as output."""

    ends: Positions
    before: Indices
    sides: Indices


@njit(inline="always")
def behind(q: Positions, i: int, planes: Planes, face: int) -> float:
    """Return the depth [m] of the position q[i] (3,) behind a face, negative in front."""
    points, normals = planes
    distance: float = -normals[face, 0] * (q[i, 0] - points[face, 0])
    distance -= normals[face, 1] * (q[i, 1] - points[face, 1])
    distance -= normals[face, 2] * (q[i, 2] - points[face, 2])
    return distance


@njit(inline="always")
def depth(q: Positions, i: int, planes: Planes, side: int) -> tuple[float, int]:
    """Return the depth [m] of q[i] (3,) behind the face of its ``side``, and that face.

    Without a side return the depth in the solid, not positive outside, and the nearest face.
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
    """Return whether q[i] is behind a face and has not slid off past another face.

    The opposite face is ignored, since a node may pass that of a thin plate.
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
    """Return the side of a node on its straight way from q[i] to end[i]: 1 + its face, or 0.

    The node counts here, however far it sticks out of the surface. A node with a side but without
    depth is on its way in or out.

    side : before the way; the node keeps it until it is out of the solid
    """
    if side > 0 and _stays(q, i, planes, side - 1):
        return side
    inside, face = depth(q, i, planes, 0)
    if inside > 0.0:
        return face + 1
    # Shares of the way
    enter, leave, side = -1.0, 1.0, 0
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
    """Points behind all faces: one face is a plane, six faces are a box."""

    planes: Planes

    @classmethod
    def of_box(cls, low: Positions, high: Positions) -> "Faces":
        """Return the box between two corners (3,) [m]."""
        # Three faces meet at each of the two corners
        points = np.repeat(np.array([low, high], float), 3, axis=0)
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
        """Return the sides (n,) of nodes that move straight from q to ``end`` (n, 3) [m].

        before : (n,) sides at q
        """
        ways = Ways(end, before, no_sides(q))
        _sides_of(len(q), q, self.planes, ways)
        return ways.sides

    def sent(self, send: Send) -> "Faces":
        return Faces(Planes(*map(send, self.planes)))


@dataclass(frozen=True)
class BallSolid(Solid):
    """Ball of center (3,) [m] and radius [m]; at the center there is no normal."""

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
        """Return the change of depth (n,) [m]: |u| - |v| = (u - v) (u + v) / (|u| + |v|)."""
        u = q - self.center
        v = u - moved
        both = np.linalg.norm(u, axis=1) + np.linalg.norm(v, axis=1)
        deeper: Floats = -(moved * (u + v)).sum(axis=1) / np.maximum(both, TINY)
        return deeper

    def sent(self, send: Send) -> "BallSolid":
        return replace(self, center=send(self.center))


def no_sides(q: Positions) -> Indices:
    """Return the sides (n,) of nodes (n, 3) without contact."""
    return np.zeros(len(q), np.int8, like=q)
