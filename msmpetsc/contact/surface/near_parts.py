"""Nearest places of candidate pairs, and places that link pairs (contact.surface.places).

A place is where two parts of the surface are nearest: two vertices, an edge and a vertex, a
triangle and a vertex, or two edges. The number of a place encodes its kind, its two parts and, for
two edges, ipctk's type of their distance.
"""

import math
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions
from msmpetsc.backend.kernel import njit
from msmpetsc.elasticity.vectors import Vector, cross, dot, vector

# Kinds of places.
VERTICES, EDGE_VERTEX, FACE_VERTEX, EDGES = range(4)
# ipctk's EdgeEdgeDistanceType of edges A and B. Rows: the vertex A0, A1, B0 or B1.
# Columns: the nearest point on the other edge is its first end, its second end or
# between.
TYPES = np.array([[0, 1, 6], [2, 3, 7], [0, 2, 4], [1, 3, 5]])
BETWEEN = 2
# ipctk's type if both nearest points are between the ends.
CROSSING = 8
# Squared sine between two edges, with their lengths at rest, below which their barrier
# fades out [-]; ipctk's value.
PARALLEL = 1e-3
# Squared sine below which rounding decides the common normal of two edges [-].
NO_NORMAL = 1e-12
TINY = float(np.finfo(float).tiny)


class Mesh(NamedTuple):
    """Mesh at rest, as kernels take it.

    Areas are a quarter of ipctk's, since vertices and edges of both surfaces push.

    edges, faces             : vertices (e, 2), (f, 3)
    sides                    : edges (f, 3) of triangles
    vertex_areas, edge_areas : (v,), (e,) [m^2]
    squares                  : squared lengths (e,) of edges [m^2]
    size                     : greater than every number of a vertex, an edge or a triangle
    """

    edges: Indices
    faces: Indices
    sides: Indices
    vertex_areas: Floats
    edge_areas: Floats
    squares: Floats
    size: int


class Parts(NamedTuple):
    """Parts (n,) of near pairs: nearest places of pairs, and places that may link pairs.

    place  : number of the place
    weight : area [m^2]
    pair   : number of the pair; two numbers for a pair of edges; -1 for a nearest place
    shared : parts with equal numbers link their pairs
    value  : b of a link, for the maximum spanning forest; infinite for a nearest place
    """

    place: Indices
    weight: Floats
    pair: Indices
    shared: Indices
    value: Floats

    @classmethod
    def empty(cls, n: int) -> "Parts":
        """Return room for n parts."""
        numbers = np.empty((3, n), int)
        return cls(numbers[0], np.empty(n), numbers[1], numbers[2], np.empty(n))


@njit(inline="always")
def _number(mesh: Mesh, kind: int, first: int, second: int, case: int) -> int:
    """Return the number of a place."""
    return ((kind * mesh.size + first) * mesh.size + second) * (CROSSING + 1) + case


@njit(inline="always")
def _barrier(square: float) -> float:
    """Return b = -(d^2 - 1)^2 ln d^2 of a squared distance d^2 < 1 in units of dhat^2."""
    return -((square - 1.0) ** 2) * math.log(max(square, TINY))


@njit(inline="always")
def _add(
    parts: Parts, n: int, place: int, weight: float, pair: int, shared: int, value: float
) -> int:
    """Write part n. Return n + 1."""
    parts.place[n], parts.weight[n], parts.pair[n] = place, weight, pair
    parts.shared[n], parts.value[n] = shared, value
    return n + 1


@njit()
def _to_edge(along: Vector, vertex: Vector) -> tuple[float, int]:
    """Return the squared distance [m^2] of a vertex from an edge, and its nearest point.

    The nearest point is at an end of the edge (0, 1) or between the ends (2).
    Ericson 2005, Real-Time Collision Detection, 5.1.2.

    along  : from the edge's first end to its second [m]
    vertex : from the edge's first end to the vertex [m]
    """
    share = min(max(dot(vertex, along) / dot(along, along), 0.0), 1.0)
    x = vertex[0] - share * along[0], vertex[1] - share * along[1], vertex[2] - share * along[2]
    return dot(x, x), 0 if share == 0.0 else 1 if share == 1.0 else BETWEEN


@njit(inline="always")
def _place_on_edge(mesh: Mesh, edge: int, where: int, vertex: int) -> int:
    """Return the number of the place of a vertex and an edge, by ``where`` of ``_to_edge``."""
    if where == BETWEEN:
        return _number(mesh, EDGE_VERTEX, edge, vertex, 0)
    end = mesh.edges[edge, where]
    return _number(mesh, VERTICES, min(end, vertex), max(end, vertex), 0)


@njit()
def _over(a: Vector, b: Vector, c: Vector, normal: Vector) -> float:
    """Return the squared distance [m^2] of a vertex from the plane of a triangle.

    It is infinite unless the vertex projects into the triangle. Ericson 2005, 5.1.5.

    a, b, c : from the vertex to the corners [m]
    """
    inside = dot(cross(a, b), normal) > 0.0 and dot(cross(b, c), normal) > 0.0
    if inside and dot(cross(c, a), normal) > 0.0:
        return dot(a, normal) ** 2 / dot(normal, normal)
    return math.inf


@njit()
def _crossing(first: Vector, second: Vector, offset: Vector) -> tuple[float, float]:
    """Return the squared distance [m^2] of the lines of two edges, and |first x second|^2 [m^4].

    The distance is infinite unless both nearest points lie within the edges. Ericson 2005, 5.1.9.

    offset : from the first edge's first end to the second edge's [m]
    """
    normal = cross(first, second)
    sine = dot(normal, normal)
    s, t = dot(cross(offset, second), normal), dot(cross(offset, first), normal)
    inside = 0.0 < s < sine and 0.0 < t < sine
    if inside and sine > NO_NORMAL * dot(first, first) * dot(second, second):
        return dot(offset, normal) ** 2 / sine, sine
    return math.inf, sine


@njit(error_model="numpy")
def add_faces(pairs: Indices, mesh: Mesh, points: Positions, limit: float, parts: Parts) -> int:
    """Write the parts of pairs (2, k) of a triangle and a vertex. Return the number of parts.

    limit : squared distance [m^2]; pairs at this distance or beyond have no parts
    """
    n = 0
    for i in range(pairs.shape[1]):
        face, v, pair = pairs[0, i], pairs[1, i], n
        a, b, c = mesh.faces[face, 0], mesh.faces[face, 1], mesh.faces[face, 2]
        normal, area = cross(vector(points, a, b), vector(points, a, c)), mesh.vertex_areas[v]
        corners = vector(points, v, a), vector(points, v, b), vector(points, v, c)
        nearest, nearest_place = _over(*corners, normal), _number(mesh, FACE_VERTEX, face, v, 0)
        for j in range(3):
            edge = mesh.sides[face, j]
            start, end = mesh.edges[edge, 0], mesh.edges[edge, 1]
            square, where = _to_edge(vector(points, start, end), vector(points, start, v))
            if square < limit:
                place = _place_on_edge(mesh, edge, where, v)
                shared = _number(mesh, FACE_VERTEX, edge, v, 0)
                n = _add(parts, n, place, area, pair, shared, _barrier(square / limit))
                if square < nearest:
                    nearest, nearest_place = square, place
        if nearest < limit:
            n = _add(parts, n, nearest_place, area, -1, 0, math.inf)
    return n


@njit(error_model="numpy")
def add_edges(
    pairs: Indices, mesh: Mesh, points: Positions, limit: float, parts: Parts, n: int
) -> int:
    """Write the parts of pairs (2, k) of edges, from part n on. Return the number of all parts.

    limit : squared distance [m^2]; pairs at this distance or beyond have no parts
    """
    for i in range(pairs.shape[1]):
        one, other, pair = pairs[0, i], pairs[1, i], n
        a, b = mesh.edges[one, 0], mesh.edges[one, 1]
        c, d = mesh.edges[other, 0], mesh.edges[other, 1]
        first, second = vector(points, a, b), vector(points, c, d)
        nearest, sine = _crossing(first, second, vector(points, a, c))
        nearest_place = _number(mesh, EDGES, one, other, CROSSING)
        fading = min(sine / (PARALLEL * mesh.squares[one] * mesh.squares[other]), 1.0)
        for j, vertex in enumerate((a, b, c, d)):
            # A vertex of one edge links pairs of the other edge.
            edge, start, along = (other, c, second) if j < 2 else (one, a, first)
            square, where = _to_edge(along, vector(points, start, vertex))
            if square < limit:
                place = _place_on_edge(mesh, edge, where, vertex)
                if fading < 1.0:
                    place = _number(mesh, EDGES, one, other, TYPES[j, where])
                shared = _number(mesh, EDGES, edge, vertex, 0)
                value = fading * (2.0 - fading) * _barrier(square / limit)
                n = _add(parts, n, place, mesh.edge_areas[edge], pair + j // 2, shared, value)
                if square < nearest:
                    nearest, nearest_place = square, place
        if nearest < limit:
            area = mesh.edge_areas[one] + mesh.edge_areas[other]
            n = _add(parts, n, nearest_place, area, -1, 0, math.inf)
    return n
