"""Points of the body nearest to the nodes of its lattice."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Indices, Mask, Positions
from msmpetsc.comm import Route
from msmpetsc.geometry.cages import BodySurface, Cages
from msmpetsc.geometry.copies import OCTANTS
from msmpetsc.geometry.morton import COPIES, decode_morton
from msmpetsc.geometry.surface import is_inside
from msmpetsc.lattice.topology import Topology


class NodePoints(NamedTuple):
    """Nearest points of the body to nodes at rest.

    points  : (l, 3) [m]
    of_part : (l,) whether the point is the nearest in the node's own parts of cells only; at a
              slit, the other parts of these cells have other nodes
    """

    points: Positions
    of_part: Mask


def nearest_of_body(bodies: Sequence[BodySurface], cages: Cages, topology: Topology) -> NodePoints:
    """Return the nearest point of its body for each node at rest (collective).

    The nearest point is the node itself, except for corners of boundary cells, which stick out
    of the surface by up to a cell diagonal. An obstacle must meet the surface, not the lattice. So
    a node that sticks out by d touches an obstacle only at depth d, where the surface is. This is
    exact, for any rotation of the body, if the surface is flat over a cell. With whole cells the
    lattice is the body, and each node is its own nearest point.

    A node at a slit narrower than a cell has the nearest point of its own side.
    """
    owned, keys = topology.ijk[: len(topology.octants)], topology.table.keys
    body = cages.grids.body_of(owned)
    # a node of eight valid cells is inside, or in a narrow fold of the surface
    is_within = topology.octants.all(axis=1) & (keys % COPIES == 0)
    rows = np.flatnonzero(~is_within & cages.is_weighted)
    nearest = cages.grids.node_positions(owned)
    nearest[rows] = nearest_in_bodies(bodies, nearest[rows], body[rows])
    of_part = np.zeros(len(nearest), bool)
    rows = np.flatnonzero(cages.copies.suspects(keys))
    in_parts = nearest_in_parts(bodies, cages, keys[rows])
    of_part[rows] = ~np.isnan(in_parts[:, 0])
    nearest[of_part] = in_parts[of_part[rows]]
    return NodePoints(
        *(topology.table.with_ghosts(topology.ghosts, rows) for rows in (nearest, of_part))
    )


def nearest_in_bodies(bodies: Sequence[BodySurface], points: Positions, body: Indices) -> Positions:
    """Return the points (n, 3) [m] of bodies that are nearest to ``points`` (n, 3) (collective).

    body : (n,) number of the body to search
    """
    # imported here because it is slow
    import igl

    to_root = Route(bodies[0].comm, np.zeros(len(points), np.int64))
    nearest = to_root.send(points)
    of_point = to_root.send(body)
    for number in np.unique(of_point):
        own = of_point == number
        surface = bodies[number].surface
        # only rank 0 receives points, and it has the surfaces
        assert surface is not None
        given = nearest[own]
        closest = igl.point_mesh_squared_distance(given, surface.points, surface.triangles)[2]
        nearest[own] = np.where(is_inside(surface, given)[:, None], given, closest)
    answer: Positions = to_root.answer(nearest)
    return answer


def nearest_in_parts(bodies: Sequence[BodySurface], cages: Cages, keys: Indices) -> Positions:
    """Return the point (n, 3) [m] nearest to each node in the node's own parts of cells.

    A row is nan unless each of the node's cells has several parts, or is separated from a
    neighbour (collective).

    keys : (n,) keys of the nodes
    """
    ijk = decode_morton(keys)
    body, cells = cages.grids.body_of(ijk), ijk[:, None] + OCTANTS
    part = cages.copies.parts_at_nodes(cages.table, keys)
    to_root = Route(bodies[0].comm, np.zeros(len(keys), np.int64))
    points, body, cells, part = (
        to_root.send(rows)
        for rows in (
            cages.grids.node_positions(ijk), body, cells - cages.grids.first(body)[:, None], part
        )
    )  # fmt: skip
    nearest = np.full(points.shape, np.nan)
    for number in np.unique(body):
        # only rank 0 receives points, and it has the parts
        if parts := cages.parts[number]:
            own = body == number
            nearest[own] = parts.nearest(points[own], cells[own], part[own])
    answer: Positions = to_root.answer(nearest)
    return answer
