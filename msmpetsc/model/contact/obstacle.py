"""Solids that nodes stay out of: convex, so that a few planes, or a ball, say what is inside."""

import math
from dataclasses import dataclass

import numba
import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import greatest, like, to_host
from msmpetsc.backend.kernel import kernel
from msmpetsc.model.lattice import Lattice
from msmpetsc.model.loads import Motion, within
from msmpetsc.model.locate import node_of_greatest
from msmpetsc.scene.motion import ObstacleTable

TOUCHING = 1e-6  # cells: no depth, but what was rounded
OPPOSITE = -1 + 1e-9  # cosine of two faces that look away from each other
TINY = 1e-300  # [m]
ROUNDED = 1e-12  # of a node's way: a plate as thin as that is not passed either


@dataclass(frozen=True)
class Obstacle:
    """The points behind all faces: one face is a plane, six are a box; or of a ball, whose one face is its sphere.

    points, normals : (f, 3) a point of each face at time 0 [m], its unit normal towards the free side; of a ball its
        centre, and no normal: that is away from it
    radius          : of the ball [m]; 0: there are planes
    path            : how it moves
    start, stop     : it is there while start <= time < stop [s]; None: to the end
    key             : of its table in the scene, for messages
    outside         : (l,) how far nodes stick out of the surface at rest [m] (contact.outside): they go so much deeper
        before the surface meets the obstacle. None: they are the surface
    """

    points: np.ndarray
    normals: np.ndarray
    path: Motion
    start: float = 0.0
    stop: float | None = None
    key: str = "obstacle"
    outside: np.ndarray | None = None
    radius: float = 0.0

    @classmethod
    def of(cls, table: ObstacleTable, key: str = "obstacle", outside: np.ndarray | None = None) -> "Obstacle":
        """Return the obstacle of a scene's table, for nodes that stick out so far."""
        if table.shape == "box":
            points = np.repeat(np.array(table.box), 3, axis=0)  # the faces that meet at each of the two corners
            normals = np.concatenate([-np.eye(3), np.eye(3)])
        elif table.shape == "sphere":
            points, normals = np.array([table.center]), np.zeros((1, 3))
        else:
            points, normals = np.array([table.point]), np.array([table.normal])
        path, radius = Motion.through(table.path), table.radius or 0.0
        return cls(points, normals, path, table.start, table.stop, key, outside, radius)

    def acts_at(self, time: float) -> bool:
        """Return whether the obstacle is there at a time [s]."""
        return within(time, self.start, self.stop)

    def points_at(self, time: float) -> np.ndarray:
        """Return a point of each face (f, 3) [m] at a time [s]."""
        return self.points + like(self.points, self.path.at(time)) if self.path.leads_away else self.points

    def depths(self, q: np.ndarray, time: float, sides: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return ``depth`` of positions (n, 3) [m] at a time [s]: depths (n,) [m] and faces (n,)."""
        return depths(q, self.points_at(time), self.normals, sides, self.outside, self.radius)

    def normals_at(self, q: np.ndarray, time: float, face: np.ndarray) -> np.ndarray:
        """Return the unit normals (n, 3) of faces (n,) at positions (n, 3) [m], at a time [s]."""
        return normals_at(q, self.points_at(time), self.normals, face, self.radius)

    def along(self, q: np.ndarray, time: float, face: np.ndarray, way: np.ndarray) -> np.ndarray:
        """Return the part (n,) [m] of a way (3,) [m] along these normals."""
        if self.radius > 0:
            return self.normals_at(q, time, face) @ like(q, way)
        return like(q, to_host(self.normals) @ way)[face]

    @property
    def has_sides(self) -> bool:
        """Whether it matters by which of its faces a node came in."""
        return len(self.normals) > 1

    def sides(
        self, q: np.ndarray, end: np.ndarray, time: float, time_step: float, before: np.ndarray | None = None
    ) -> np.ndarray:
        """Return ``side_of`` (n,) of nodes that go straight from q to ``end`` (n, 3) [m] in a step ending at ``time``.

        before : (n,) the sides when it began. A node that the obstacle appears around gets the face nearest to it.
        """
        sides = no_sides(q)
        if not self.acts_at(time):
            return sides
        begin = max(time - time_step, 0.0)
        if not self.acts_at(begin):
            q, begin = end, time
        _sides_of(
            len(q), q, end, self.points_at(begin), self.points_at(time), self.normals,
            no_sides(q) if before is None else before, sides,
        )  # fmt: skip
        return sides


@numba.njit(cache=True)
def behind(x: np.ndarray, points: np.ndarray, normals: np.ndarray, face: int) -> float:
    """Return how far x (3,) lies behind a face [m]; negative in front of it."""
    distance = 0.0
    for c in range(3):
        distance -= normals[face, c] * (x[c] - points[face, c])
    return distance


@numba.njit(cache=True)
def away(x: np.ndarray, points: np.ndarray) -> float:
    """Return how far x (3,) is from the first of the points (f, 3), a ball's centre [m]."""
    return math.sqrt((x[0] - points[0, 0]) ** 2 + (x[1] - points[0, 1]) ** 2 + (x[2] - points[0, 2]) ** 2)


@numba.njit(cache=True)
def normal_at(x: np.ndarray, points: np.ndarray, normals: np.ndarray, face: int, radius: float) -> tuple:
    """Return the three components of the unit normal of a face at x (3,); at a ball's very centre there is none."""
    if radius > 0.0:
        far = max(away(x, points), TINY)
        return (x[0] - points[0, 0]) / far, (x[1] - points[0, 1]) / far, (x[2] - points[0, 2]) / far
    return normals[face, 0], normals[face, 1], normals[face, 2]


@numba.njit(cache=True)
def depth(
    x: np.ndarray, points: np.ndarray, normals: np.ndarray, side: int, outside: float, radius: float
) -> tuple[float, int]:
    """Return how deep the surface at x (3,) lies behind the face of its ``side`` [m], and that face.

    Without a side: how deep in the solid, not positive outside, and the nearest face.

    outside : how far the node at x sticks out of the surface [m]
    radius  : of a ball [m]; 0: there are planes
    """
    if radius > 0.0:
        return radius - away(x, points) - outside, 0
    if side > 0:
        return behind(x, points, normals, side - 1) - outside, side - 1
    least, face = np.inf, 0
    for f in range(len(points)):
        distance = behind(x, points, normals, f)
        if distance < least:
            least, face = distance, f
    return least - outside, face


@kernel
def _depth_of(first, count, step, q, points, normals, sides, outside, radius, least, face):
    for i in range(first, count, step):
        least[i], face[i] = depth(q[i], points, normals, sides[i], outside[i], radius)


def depths(
    q: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    sides: np.ndarray | None = None,
    outside: np.ndarray | None = None,
    radius: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``depth`` of positions (n, 3), with sides and outside (n or more,): depths (n,) [m], faces (n,)."""
    least, face = np.empty(len(q), like=q), np.empty(len(q), np.int64, like=q)
    sides = no_sides(q) if sides is None else sides
    _depth_of(len(q), q, points, normals, sides, of_nodes(outside, q), radius, least, face)
    return least, face


def normals_at(q: np.ndarray, points: np.ndarray, normals: np.ndarray, face: np.ndarray, radius: float) -> np.ndarray:
    """Return the unit normals (n, 3) at positions (n, 3) of faces (n,); as ``normal_at`` does."""
    if radius > 0:
        from_centre = q - points[0]
        return from_centre / np.maximum(np.linalg.norm(from_centre, axis=1), TINY)[:, None]
    return normals[face]


def of_nodes(outside: np.ndarray | None, q: np.ndarray) -> np.ndarray:
    """Return how far the nodes at q (n, 3) stick out of the surface, (n or more,) [m]; by default not at all."""
    return np.zeros(len(q), like=q) if outside is None else outside


def no_sides(q: np.ndarray) -> np.ndarray:
    """Return the sides (n,) of nodes (n, 3) that are in contact with nothing."""
    return np.zeros(len(q), np.int8, like=q)


@numba.njit(cache=True)
def _stays(x: np.ndarray, points: np.ndarray, normals: np.ndarray, face: int) -> bool:
    """Return whether x lies behind a face and has not slid off it past another.

    The opposite face is left aside: that of a thin plate may be passed.
    """
    if behind(x, points, normals, face) <= 0.0:
        return False
    for f in range(len(points)):
        along = 0.0
        for c in range(3):
            along += normals[f, c] * normals[face, c]
        if along > OPPOSITE and behind(x, points, normals, f) <= 0.0:
            return False
    return True


@numba.njit(cache=True)
def side_of(
    x: np.ndarray, end: np.ndarray, points: np.ndarray, points_end: np.ndarray, normals: np.ndarray, side: int
) -> int:
    """Return 1 + the face by which a node is in contact on its straight way from x to ``end`` (3,), 0 if it meets none.

    points, points_end : (f, 3) where the faces are meanwhile; as seen from the solid, too, the way is straight
    side               : by which it was before: it keeps that until it is out of the solid

    It is the node that counts here, however far it sticks out of the surface: with a side, but no depth yet, it is on
    its way in, or out again.
    """
    if side > 0 and _stays(x, points, normals, side - 1):
        return side
    inside, face = depth(x, points, normals, 0, 0.0, 0.0)
    if inside > 0.0:
        return face + 1
    enter, leave, side = -1.0, 1.0, 0  # fractions of the way
    for f in range(len(points)):
        first, last = behind(x, points, normals, f), behind(end, points_end, normals, f)
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
def _sides_of(first, count, step, q, end, points, points_end, normals, before, sides):
    for i in range(first, count, step):
        sides[i] = side_of(q[i], end[i], points, points_end, normals, before[i])


def describe_overlap(
    comm: MPI.Comm, lattice: Lattice, obstacle: Obstacle, q: np.ndarray, held: np.ndarray, time: float
) -> str | None:
    """Describe the free nodes that lie inside an obstacle as it stands at a time [s]; None if none does (collective).

    A scene seldom means that, and what reflects leaves them inside.

    q, held : (l, 3) [m]; (l,) bool, the nodes that are not free
    """
    owned = slice(lattice.owned)
    inside, _ = obstacle.depths(q[owned], time)
    rows = np.flatnonzero((inside > TOUCHING * lattice.cell_size) & ~held[owned])
    count = comm.allreduce(len(rows))
    if not count:
        return None
    deepest = comm.allreduce(greatest(inside[rows]), MPI.MAX)
    nodes = f"{count} node{'s' if count > 1 else ''}"
    worst = node_of_greatest(comm, lattice, rows, inside[rows])
    return (
        f"{nodes} inside {obstacle.key}, up to {deepest:.3g} m ({deepest / lattice.cell_size:.2g} cells) deep: {worst}"
    )
