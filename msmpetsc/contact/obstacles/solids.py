"""Solids as shapes of obstacles: half spaces, boxes and balls.

A solid has a fixed pose: its pose at time 0. If the obstacle moves, positions are given in its
frame.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows
from msmpetsc.backend.kernel import kernel, njit

# smallest length to divide by [m]
TINY = 1e-300
# rounding of a crossing [fraction of a path]; so that a plate of zero thickness stops
# nodes
ROUNDED = 1e-12

Send = Callable[[Array], Array]


class Solid(ABC):
    """A solid with faces numbered from 0. Positions are (n, 3) [m]."""

    @property
    def has_sides(self) -> bool:
        """Whether the depth depends on the face by which a node entered."""
        return False

    @abstractmethod
    def depths(self, q: Positions, sides: Indices | None = None) -> tuple[Floats, Indices]:
        """Return the depths (n,) [m] of positions behind a face, and the numbers (n,) of the faces.

        Outside, the depth is negative. Its magnitude is at most the distance to the solid.

        sides : (n or more,) 1 + the face by which each node entered; 0 for the nearest face
        """

    @abstractmethod
    def normals(self, q: Positions, face: Indices) -> Rows:
        """Return the outward unit normals (n, 3) of the faces (n,) at positions in the solid."""

    @abstractmethod
    def depth_change(self, q: Positions, moved: Rows, face: Indices) -> Floats:
        """Return the change of depth (n,) [m] behind faces (n,) from q - moved to q, in the solid.

        A difference of two depths would lose the digits of a small displacement.

        moved : (n, 3) displacement [m]
        """

    def sent(self, send: Send) -> "Solid":
        """Return the solid with the arrays that a step uses, moved to a device by ``send``."""
        return self


class Planes(NamedTuple):
    """Planes of faces: points (f, 3) [m], and outward unit normals (f, 3)."""

    points: Positions
    normals: Rows


class Depths(NamedTuple):
    """Sides (n or more,) of nodes, and a kernel's output: depths (n,) [m] and faces (n,)."""

    sides: Indices
    depths: Floats
    faces: Indices


class Paths(NamedTuple):
    """Ends (n, 3) [m] of nodes' paths, sides (n,) before, and a kernel's output: sides (n,)."""

    ends: Positions
    before: Indices
    sides: Indices


@njit(inline="always")
def behind(q: Positions, i: int, planes: Planes, face: int) -> float:
    """Return the distance [m] of q[i] behind the plane of a face; negative in front of it."""
    points, normals = planes
    distance: float = -normals[face, 0] * (q[i, 0] - points[face, 0])
    distance -= normals[face, 1] * (q[i, 1] - points[face, 1])
    distance -= normals[face, 2] * (q[i, 2] - points[face, 2])
    return distance


@njit(inline="always")
def depth(q: Positions, i: int, planes: Planes, side: int) -> tuple[float, int]:
    """Return the depth [m] of q[i] behind the face of its ``side``, and the number of the face.

    If ``side`` is 0, return the depth in the solid and the nearest face. Outside, the depth is not
    positive.
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
    """Return whether q[i] is behind a face and has not slid off the face sideways.

    The opposite face does not count, because a node may be beyond the far face of a thin plate.
    """
    if behind(q, i, planes, face) <= 0.0:
        return False
    for f in range(len(planes.points)):
        along = 0.0
        for c in range(3):
            along += planes.normals[f, c] * planes.normals[face, c]
        # the normals of a box are exact
        if along > -1.0 and behind(q, i, planes, f) <= 0.0:
            return False
    return True


@njit()
def side_of(q: Positions, end: Positions, i: int, planes: Planes, side: int) -> int:
    """Return 1 + the face by which a node is in contact on its straight path from q[i] to end[i].

    The result is 0 if the node does not meet the solid. The node itself is tested, which may lie
    outside the body's surface. So a node with a side may still have no depth.

    side : the node's side before the step, which it keeps until it leaves the solid
    """
    if side > 0 and _stays(q, i, planes, side - 1):
        return side
    inside, face = depth(q, i, planes, 0)
    if inside > 0.0:
        return face + 1
    # Fractions of the path at which the node enters and leaves the solid.
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
def _sides_of(
    first: int, count: int, step: int, q: Positions, planes: Planes, paths: Paths
) -> None:
    ends, before, sides = paths
    for i in range(first, count, step):
        sides[i] = side_of(q, ends, i, planes, before[i])


@dataclass(frozen=True)
class Faces(Solid):
    """The points behind all faces: a half space with a single face, or a box with six."""

    planes: Planes

    @classmethod
    def of_box(cls, low: Positions, high: Positions) -> "Faces":
        """Return the box between two corners (3,) [m]."""
        # Three faces meet at each of the two corners.
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

    def depth_change(self, q: Positions, moved: Rows, face: Indices) -> Floats:
        change: Floats = -(moved * self.planes.normals[face]).sum(axis=1)
        return change

    def sides_of(self, q: Positions, end: Positions, before: Indices) -> Indices:
        """Return ``side_of`` (n,) for nodes on straight paths from q to ``end`` (n, 3) [m].

        before : (n,) the nodes' sides before the step
        """
        paths = Paths(end, before, no_sides(q))
        _sides_of(len(q), q, self.planes, paths)
        return paths.sides

    def sent(self, send: Send) -> "Faces":
        return Faces(Planes(*map(send, self.planes)))


@dataclass(frozen=True)
class BallSolid(Solid):
    """A ball: center (3,) [m] and radius [m]. The normal at its center is zero."""

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

    def depth_change(self, q: Positions, moved: Rows, face: Indices) -> Floats:
        # |u| - |v| = (u - v) . (u + v) / (|u| + |v|)
        u = q - self.center
        v = u - moved
        both = np.linalg.norm(u, axis=1) + np.linalg.norm(v, axis=1)
        change: Floats = -(moved * (u + v)).sum(axis=1) / np.maximum(both, TINY)
        return change

    def sent(self, send: Send) -> "BallSolid":
        return replace(self, center=send(self.center))


def no_sides(q: Positions) -> Indices:
    """Return the sides (n,) of nodes (n, 3) without contact: zeros."""
    return np.zeros(len(q), np.int8, like=q)
