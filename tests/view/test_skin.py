"""The surface as drawn: points in long edges, and sharp edges that split the shading."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.sparse import csr_array
from scipy.spatial import Delaunay
from surface_alone import drawable_of

from msmpetsc.view.colours import FIXED, colouring_of
from msmpetsc.view.composition import Style, composition_of
from msmpetsc.view.drawable import BodiesAtRest, Drawable
from msmpetsc.view.mesh import CORNERS, drawn, split_at_edges, subdivided, trilinear
from msmpetsc.view.renderer import Renderer

# a block of 1 x 1/8 x 1/8 m
CELLS, H = np.array([16, 2, 2]), 1 / 16


def bent(points: np.ndarray) -> np.ndarray:
    """Return a beam whose end sinks by 0.3 m."""
    return points - 0.3 * points[:, [0]] ** 2 * [0, 0, 1]


def block() -> Drawable:
    """Return a block of 12 triangles and its 64 cells, at rest and bent."""
    box = trimesh.creation.box(bounds=[[0, 0, 0], H * CELLS])
    points, triangles = np.array(box.vertices), np.array(box.faces)
    low = np.argwhere(np.ones(CELLS))[:, None]
    cells = np.ravel_multi_index(np.moveaxis(low + CORNERS, -1, 0), tuple(CELLS + 1))
    nodes = H * np.argwhere(np.ones(CELLS + 1))
    W = csr_array((np.linalg.norm(points[:, None] - nodes, axis=2) < 1e-9).astype(float))
    zeros = np.zeros(len(points), int)
    return replace(
        drawable_of(points, triangles),
        rest=BodiesAtRest(nodes, cells, points, np.zeros(len(nodes), int), zeros),
        times=np.arange(2.0),
        nodes=lambda index: bent(nodes) if index else nodes,
        embedding=W,
    )


def test_a_block_of_twelve_triangles_is_drawn_as_its_cells_bend():
    subject = drawn(block())
    rest, points = subject.rest.points, subject.surface(1)
    assert len(subject.triangles) > 12 and len(points) == len(rest)
    mesh = trimesh.Trimesh(rest, subject.triangles, process=False)
    assert mesh.edges_unique_length.max() <= H * (1 + 1e-9)
    # trilinear between nodes: 0.3 h^2 / 4 off the parabola in the middle of a cell,
    # where 12 triangles are off by 0.075
    assert points == pytest.approx(bent(rest), abs=0.3 * H**2 / 4 + 1e-9)
    assert subject.embedding @ subject.nodes(1) == pytest.approx(points)


def test_long_edges_are_divided_without_holes():
    box = trimesh.creation.box([1, 0.3, 0.1])
    points, triangles, part_of = subdivided(np.array(box.vertices), np.array(box.faces), 0.07)
    mesh = trimesh.Trimesh(points, triangles, process=False)
    assert mesh.is_watertight and mesh.volume == pytest.approx(0.03)
    assert mesh.edges_unique_length.max() <= 0.07 and (points[:8] == box.vertices).all()
    assert mesh.face_normals == pytest.approx(box.face_normals[part_of])


def test_normals_are_split_at_sharp_edges_alone():
    """A cube has three normals at each corner, a fine ball a single normal per point."""
    cube, ball = trimesh.creation.box([1, 1, 1]), trimesh.creation.icosphere(subdivisions=2)
    origin, triangles = split_at_edges(np.array(cube.vertices), np.array(cube.faces))
    assert len(origin) == 24 and (origin[triangles] == cube.faces).all()
    for point in range(24):
        around = cube.face_normals[(triangles == point).any(axis=1)]
        assert around == pytest.approx(np.tile(around[0], (len(around), 1)))
    smooth, _ = split_at_edges(np.array(ball.vertices), np.array(ball.faces))
    assert len(smooth) == len(ball.vertices)


@pytest.mark.parametrize(("degrees", "points"), [(25, 6), (35, 8)])
def test_an_edge_is_sharp_from_thirty_degrees_on(degrees: float, points: int):
    """Two squares meet in an edge of two points."""
    angle = np.radians(degrees)
    ends = [(-1, 0), (0, 0), (np.cos(angle), np.sin(angle))]
    corners = np.array([(x, y, z) for x, z in ends for y in (0, 1)])
    triangles = np.array([[0, 2, 1], [1, 2, 3], [2, 4, 3], [3, 4, 5]])
    assert len(split_at_edges(corners, triangles)[0]) == points


def test_a_mesh_whose_triangles_share_no_points_is_drawn_smooth():
    """Triangles without shared points are as in an STL file."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    loose = np.array(ball.triangles.reshape(-1, 3)), np.arange(3 * len(ball.faces)).reshape(-1, 3)
    assert len(np.unique(drawn(drawable_of(*loose)).triangles)) == len(ball.vertices)


def test_pins_are_coloured_up_to_where_half_of_a_point_is_held():
    """A flat strip, held at one end, has two colours seen from above, and none in between."""
    x = np.arange(6.0)
    points = np.array([(a, b, 0) for a in x for b in (0, 1)])
    triangles = np.array(
        [t for k in range(0, 10, 2) for t in ((k, k + 2, k + 1), (k + 1, k + 2, k + 3))]
    )
    share = np.where(points[:, 0] < 1.5, 1.0, 0.3)
    subject = drawable_of(points, triangles)
    rest = replace(subject.rest, nodes=np.tile(points, (2, 1)), body_of_node=np.zeros(24, int))
    subject = replace(
        subject, rest=rest, pinned=np.repeat([True, False], 12), nodes=lambda _: rest.nodes,
        embedding=csr_array(np.hstack([np.diag(share), np.diag(1 - share)])),
    )  # fmt: skip
    composition = composition_of(subject, [0], Style(eye=(0, 0, 1)))
    stills = composition.stills([0])
    with Renderer(composition, stills, (300, 60)) as renderer:
        row = renderer.picture(stills[0])[30].astype(int)
    # the part without the rim
    colours = row[(row < 250).any(axis=1)][3:-3]
    steps = np.flatnonzero(np.abs(np.diff(colours, axis=0)).max(axis=1) > 2)
    assert len(steps) and np.ptp(steps) <= 2, "one edge, which antialiasing may widen by two pixels"
    # between the second and the third pair of points
    border = (1 + (1.0 - 0.5) / (1.0 - 0.3)) / 5
    assert steps[0] == pytest.approx(border * len(colours), abs=4)
    assert colours[0, 0] < colours[-1, 0] - 30


def test_bodies_have_a_colour_each():
    subject = block()
    halves = replace(subject.rest, body_of_point=np.repeat([0, 1], 4))
    for bodies, one in enumerate((subject, replace(subject, rest=halves)), 1):
        colouring = colouring_of(one, None)
        assert len(np.unique(colouring.table[colouring.numbers(0)], axis=0)) == bodies


def test_a_clamp_ends_in_a_straight_line_whatever_the_triangles():
    """Triangles of any shape form the front of a block, pinned up to a plane of the lattice."""
    whole, size = block(), H * CELLS
    inner = np.random.default_rng(0).uniform([0, 0], size[[0, 2]], (400, 2))
    flat = np.concatenate([np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size[[0, 2]], inner])
    points = np.insert(flat, 1, 0.0, axis=1)
    rest = replace(whole.rest, points=points, body_of_point=np.zeros(len(points), int))
    W = trilinear(rest, points, rest.body_of_point)
    triangles = Delaunay(flat).simplices
    pinned = rest.nodes[:, 0] < 4.1 * H
    clamped = replace(whole, rest=rest, embedding=W, triangles=triangles, pinned=pinned)
    composition = composition_of(drawn(clamped), [0], Style(eye=(0, -1, 0)))
    stills = composition.stills([0])
    low, high, _ = composition.room(stills)
    # pixels per metre
    scale = 900 / (high - low)[0]
    with Renderer(composition, stills, (900, round(scale * (high - low)[1]))) as renderer:
        picture = renderer.picture(stills[0]).astype(int)
    dark = abs(picture - [int(FIXED[k : k + 2], 16) for k in (1, 3, 5)]).max(axis=2) < 40
    rows = np.flatnonzero(dark.sum(axis=1) > 10)[5:-5]
    ends = np.array([np.flatnonzero(dark[row])[-1] for row in rows])
    assert len(rows) > 80 and np.ptp(ends) <= 4, "corners of triangles stand out by 38 pixels"
    # half a cell beyond
    assert np.ptp(np.flatnonzero(dark.any(axis=0))) == pytest.approx(4.5 * H * scale, abs=2)
