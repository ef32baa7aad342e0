"""The meshes that are drawn: the surface, and cells and springs of the half of the lattice behind its middle.

Triangles of the surface that are larger than cells follow the cells that carry them, and sharp edges are sharp. Drawn
points are those of the file, in their order, then those put into long edges, then copies along sharp edges.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array, eye_array, vstack
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from msmpetsc.errors import InputError
from msmpetsc.results.gaps import unit_vectors
from msmpetsc.view.camera import Camera
from msmpetsc.view.colours import BOUNDARY_CELL, INTERIOR_CELL, SPRING
from msmpetsc.view.drawable import Drawable
from msmpetsc.view.overlays import Rest

# The surface


SHARP = np.cos(np.radians(30))  # of the angle between the normals of two triangles: beyond it their edge is sharp
HELD = 0.5  # share of a point that is fixed: a triangle is whose corners all have more
MOST = 30_000  # triangles, roughly: however small the cells, edges are not divided into more
CORNERS = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])  # of a cell, VTK's order


def drawn(subject: Drawable) -> Drawable:
    """Return the subject with its surface as it is drawn."""
    return _split(_refined(subject))


def _refined(subject: Drawable) -> Drawable:
    """Return the subject with no edge of its surface longer than a cell, new points carried by the cells."""
    rest, W = subject.rest, subject.embedding
    cell = float(np.ptp(rest.nodes[rest.cells[0]], axis=0).max()) if len(rest.cells) else 0.0
    if W is None or cell == 0:
        return subject
    a, b, c = rest.points[subject.triangles].swapaxes(0, 1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    finer = subdivided(rest.points, subject.triangles, max(cell, float(np.sqrt(2 * area / MOST))))
    old, new = len(rest.points), len(finer.points)
    if new == old:
        return subject
    body = rest.body_of_point[np.asarray(finer.carry.argmax(axis=1)).ravel()]
    T = trilinear(rest, finer.points[old:], body[old:])
    return replace(
        subject,
        rest=replace(rest, points=finer.points, body_of_point=body),
        triangles=finer.triangles,
        surface=lambda index: np.concatenate([subject.surface(index), T @ subject.nodes(index)]),
        embedding=csr_array(vstack([W, T])),
        carry=finer.carry,
    )


@dataclass(frozen=True)
class Subdivided:
    """Points (p, 3) and triangles (f, 3), and carry (p, v): numbers at the v points before -> numbers at these."""

    points: np.ndarray
    triangles: np.ndarray
    carry: csr_array


def subdivided(points: np.ndarray, triangles: np.ndarray, longest: float) -> Subdivided:
    """Return a surface whose edges longer than `longest` [m] are halved, again and again, the first points kept."""
    carry = csr_array(eye_array(len(points)))
    while True:
        half_edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, number = np.unique(half_edges, axis=0, return_inverse=True)
        long = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1) > longest
        if not long.any():
            return Subdivided(points, triangles, carry)
        middle = np.where(long, len(points) + np.cumsum(long) - 1, -1)[number].reshape(-1, 3)
        ends = edges[long]
        points = np.concatenate([points, points[ends].mean(axis=1)])
        halves = csr_array(
            (np.full(ends.size, 0.5), ends.ravel(), 2 * np.arange(len(ends) + 1)), (len(ends), carry.shape[0])
        )
        carry = csr_array(vstack([carry, halves @ carry]))
        triangles = _divided(triangles, middle)


def _divided(triangles: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Return the pieces of triangles (f, 3); middle (f, 3): the points in their edges 01, 12, 20, -1 for none."""
    pieces = [triangles[(middle < 0).all(axis=1)]]
    for turn in range(3):  # each kind of division begins at one edge or corner
        t, m = (np.roll(part, -turn, axis=1) for part in (triangles, middle))
        cut = m >= 0
        one = cut[:, 0] & ~cut[:, 1] & ~cut[:, 2]
        (a, b, c), (ab, _, _) = t[one].T, m[one].T
        pieces += [np.stack([a, ab, c], axis=1), np.stack([ab, b, c], axis=1)]
        two = cut[:, 0] & cut[:, 1] & ~cut[:, 2]
        (a, b, c), (ab, bc, _) = t[two].T, m[two].T
        pieces += [np.stack(piece, axis=1) for piece in ((ab, b, bc), (a, ab, bc), (a, bc, c))]
    three = (middle >= 0).all(axis=1)
    (a, b, c), (ab, bc, ca) = triangles[three].T, middle[three].T
    pieces += [np.stack(piece, axis=1) for piece in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate(pieces)


def trilinear(rest: Rest, points: np.ndarray, body: np.ndarray) -> csr_array:
    """Return the matrix (p, n) that carries points (p, 3) of bodies (p,) by the corners of the cells around them."""
    of_cell = rest.body_of_node[rest.cells[:, 0]]
    around = np.empty(len(points), int)
    for number in np.unique(body):
        own, inside = np.flatnonzero(of_cell == number), body == number
        around[inside] = own[KDTree(rest.middles[own]).query(points[inside], p=np.inf)[1]]  # cubes: the nearest
    corners = rest.cells[around]
    low, high = rest.nodes[corners[:, 0]], rest.nodes[corners[:, 6]]
    u = np.clip((points - low) / (high - low), 0, 1)[:, None]
    weights = np.where(CORNERS, u, 1 - u).prod(axis=2)
    starts = 8 * np.arange(len(points) + 1)
    return csr_array((weights.ravel(), corners.ravel(), starts), (len(points), len(rest.nodes)))


def _split(subject: Drawable) -> Drawable:
    """Return the subject with a copy of each point for every smooth piece of the surface around it."""
    rest, W = subject.rest, subject.embedding
    _, first, equal = np.unique(
        np.column_stack([rest.body_of_point, rest.points]), axis=0, return_index=True, return_inverse=True
    )
    origin, triangles = split_at_edges(rest.points, first[equal.ravel()][subject.triangles])
    if len(origin) == len(rest.points):
        return replace(subject, triangles=triangles)
    of_point = rest.body_of_point[origin]
    rest = replace(rest, points=rest.points[origin], body_of_point=of_point)
    same_nodes = subject.rest.nodes is subject.rest.points  # of a surface alone
    return replace(
        subject,
        rest=replace(rest, nodes=rest.points, body_of_node=of_point) if same_nodes else rest,
        triangles=triangles,
        nodes=(lambda index: subject.nodes(index)[origin]) if same_nodes else subject.nodes,
        surface=lambda index: subject.surface(index)[origin],
        embedding=None if W is None else W[origin],
        carry=(csr_array(eye_array(len(subject.rest.points))) if subject.carry is None else subject.carry)[origin],
    )


def split_at_edges(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points that drawn points are copies of, (d,), the first v themselves, and triangles (f, 3) of them.

    Two corners of triangles at one point stay one drawn point where no sharp edge parts them.
    """
    a, b, c = points[triangles].swapaxes(0, 1)
    normals = unit_vectors(np.cross(b - a, c - a))
    half_edges = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)  # of corner 3 t + k
    order = np.lexsort(np.sort(half_edges, axis=1).T)
    ours, theirs = order[:-1], order[1:]
    same = (np.sort(half_edges[ours], axis=1) == np.sort(half_edges[theirs], axis=1)).all(axis=1)
    across = np.einsum("ij,ij->i", normals[ours // 3], normals[theirs // 3])
    flat = ~(normals[ours // 3].any(axis=1) & normals[theirs // 3].any(axis=1))  # a triangle without area parts nothing
    joined = same & ((across >= SHARP) | flat)
    ours, theirs = ours[joined], theirs[joined]
    ends = lambda edge: (edge, edge - edge % 3 + (edge + 1) % 3)  # noqa: E731  corners at its start and its end
    (a, b), (c, d) = ends(ours), ends(theirs)
    opposite = triangles.ravel()[a] == triangles.ravel()[d]  # as neighbours that are wound alike run along an edge
    pairs = np.concatenate([a, b]), np.concatenate([np.where(opposite, d, c), np.where(opposite, c, d)])
    corners = triangles.size
    pieces, piece = connected_components(csr_array((np.ones(len(pairs[0]), bool), pairs), (corners, corners)), False)
    of_piece = np.empty(pieces, int)
    of_piece[piece] = triangles.ravel()
    kept, first = np.unique(of_piece, return_index=True)
    others = np.setdiff1d(np.arange(pieces), first)
    number = np.empty(pieces, int)
    number[first], number[others] = kept, len(points) + np.arange(len(others))
    return np.concatenate([np.arange(len(points)), of_piece[others]]), number[piece].reshape(-1, 3)


# The lattice


SHOWN = ("cells", "springs")
BOUNDARY, INTERIOR = 1, 2  # lattice/cell_kind
SHRUNK = 0.86  # of a cell's size, so that neighbours are told apart
THROUGH = 0.3  # opacity of a body whose lattice is shown
FACES = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])  # VTK's order
KINDS = {BOUNDARY: (BOUNDARY_CELL, "boundary cell"), INTERIOR: (INTERIOR_CELL, "interior cell")}


@dataclass(frozen=True)
class LatticeMesh:
    """Faces (f, 4) or lines (s, 2) between points (p, 3) [m], of one colour."""

    points: np.ndarray
    joined: np.ndarray
    colour: str


@dataclass(frozen=True)
class Cut:
    """What is left of the lattice when the half before its middle is taken away.

    cells   : (c, 8) by their kind
    springs : (s, 2), both ends of which lie behind
    """

    cells: dict[int, np.ndarray]
    springs: np.ndarray

    def meshes(self, nodes: np.ndarray) -> tuple[LatticeMesh, ...]:
        """Return cells and springs at positions (n, 3) of the nodes."""
        parts = [_cells(nodes, cells, KINDS[kind][0]) for kind, cells in self.cells.items()]
        return (*parts, LatticeMesh(nodes, self.springs, SPRING)) if len(self.springs) else tuple(parts)


def cut_open(subject: Drawable, camera: Camera, shown: tuple[str, ...]) -> Cut:
    """Return the half of the lattice behind the middle of the body at rest. Raises InputError where there is none."""
    if not len(subject.rest.cells):
        raise InputError(f"--show: {subject.name} is a mesh without cells")
    nodes, cells = subject.rest.nodes, subject.rest.cells
    depth = nodes @ camera.to_eye
    middle = (depth.min() + depth.max()) / 2
    behind = depth[cells].mean(axis=1) <= middle
    kind = subject.array("lattice/cell_kind")
    parts = {number: cells[behind & (kind == number)] for number in KINDS} if "cells" in shown else {}
    springs = np.empty((0, 2), int)
    if "springs" in shown:
        springs = subject.springs
        springs = springs[(depth[springs] <= middle).all(axis=1)]
    return Cut({number: part for number, part in parts.items() if len(part)}, springs)


def _cells(nodes: np.ndarray, cells: np.ndarray, colour: str) -> LatticeMesh:
    corners = nodes[cells]
    middles = corners.mean(axis=1, keepdims=True)
    points = (middles + SHRUNK * (corners - middles)).reshape(-1, 3)
    faces = (8 * np.arange(len(cells))[:, None, None] + FACES).reshape(-1, 4)
    return LatticeMesh(points, faces, colour)
