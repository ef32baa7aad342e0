"""Gaps of a surface to obstacles and to its own parts: where they are known, and where nothing is to be touched."""

import numpy as np
import pytest
import trimesh
from surfaces import surface_of

from msmpetsc.scene.obstacles import ObstacleTable
from msmpetsc.view.gaps import SurfaceGaps, gaps_to_obstacles

SIDE, GAP, REACH = 0.1, 0.001, 0.002  # [m]


def obstacle(**table) -> ObstacleTable:
    return ObstacleTable.model_validate(table)


PLANE = obstacle(shape="plane", point=[0, 0, 1], normal=[0, 0, 3])
BOX = obstacle(shape="box", box=[[0, 0, 0], [1, 2, 3]])
BALL = obstacle(shape="sphere", center=[0, 0, 0], radius=0.5)
CASES = [
    (PLANE, [7, 7, 1.25], 0.25),
    (PLANE, [7, 7, 0.5], -0.5),
    (BOX, [0.5, 1, 3.1], 0.1),
    (BOX, [1.3, 2.4, 1], 0.5),  # beside an edge: 3-4-5
    (BOX, [0.5, 0.2, 1], -0.2),
    (BALL, [0, 3, 4], 4.5),
    (BALL, [0, 0, 0.4], -0.1),
]


@pytest.mark.parametrize(("table", "point", "gap"), CASES)
def test_gap_to_an_obstacle(table: ObstacleTable, point: list[float], gap: float):
    assert gaps_to_obstacles([table], {}, np.array([point]), 0.0) == pytest.approx(gap)


def test_the_nearest_obstacle_counts_where_it_is_by_then():
    moves = obstacle(
        shape="plane", point=[0, 0, 0], normal=[0, 0, 1], path=[{"time": 1.0, "by": [0, 0, 0.5]}], stop=1.5
    )
    points = np.array([[0, 0, 0.8]])
    gaps = [gaps_to_obstacles([moves], {}, points, time)[0] for time in (0.0, 0.5, 1.2, 1.6)]
    assert gaps == pytest.approx([0.8, 0.55, 0.3, np.inf])
    assert gaps_to_obstacles([moves, PLANE], {}, points, 0.0) == pytest.approx(-0.2)


def test_the_gap_to_a_surface_is_that_to_what_it_encloses():
    solid = surface_of(trimesh.creation.icosphere(subdivisions=4, radius=0.5))
    table = obstacle(shape="mesh", mesh={"source": "ball.ply"})
    points = np.random.default_rng(3).normal(size=(200, 3))
    points *= np.linspace(0.3, 0.7, 200)[:, None] / np.linalg.norm(points, axis=1)[:, None]
    gaps = gaps_to_obstacles([PLANE, table], {1: solid}, points, 0.0)
    assert gaps == pytest.approx(np.minimum(np.linalg.norm(points, axis=1) - 0.5, points[:, 2] - 1), abs=2e-3)
    gaps = gaps_to_obstacles([table], {0: solid}, points, 0.0)
    assert gaps == pytest.approx(np.linalg.norm(points, axis=1) - 0.5, abs=2e-3)
    assert np.isinf(gaps_to_obstacles([table], {}, points, 0.0)).all()  # a result without its surface


def block(low: list[float], sides: list[float]) -> trimesh.Trimesh:
    """A block of triangles of about a tenth of its sides."""
    mesh = trimesh.creation.box([1, 1, 1])
    for _ in range(3):
        mesh = mesh.subdivide()
    return trimesh.Trimesh((mesh.vertices + 0.5) * sides + low, mesh.faces, process=False)


def two_blocks(gap: float) -> np.ndarray:
    """Points of two blocks, the second so far above the first."""
    pair = [block([0, 0, z], [SIDE, SIDE, SIDE]).vertices for z in (0, SIDE + gap)]
    return np.concatenate(pair)


TRIANGLES = block([0, 0, 0], [1, 1, 1]).faces
PAIR = np.concatenate([TRIANGLES, TRIANGLES + TRIANGLES.max() + 1])
HALF = TRIANGLES.max() + 1


@pytest.mark.parametrize("bodies", [1, 2])
@pytest.mark.parametrize("gap", [GAP, 1e-6])
def test_parts_that_came_near_each_other(bodies: int, gap: float):
    """All points of the two sides that face each other, and none beside, behind or above."""
    body = np.repeat([0, bodies - 1], HALF)
    gaps = SurfaceGaps(two_blocks(0.05), PAIR, body, REACH).distances(two_blocks(gap))
    height = two_blocks(gap)[:, 2]
    facing = (abs(height - SIDE) < 1e-9) | (abs(height - SIDE - gap) < 1e-9)
    inner = facing & (abs(two_blocks(gap)[:, :2] - SIDE / 2) < 0.49 * SIDE).all(axis=1)
    assert gaps[inner] == pytest.approx(gap, rel=1e-6) and inner.sum() > 50
    assert np.isinf(gaps[~facing]).all()


def test_what_was_near_at_rest_is_a_crease_of_one_body_and_a_meeting_of_two():
    rest = two_blocks(GAP)
    assert np.isinf(SurfaceGaps(rest, PAIR, np.zeros(2 * HALF, int), REACH).distances(rest)).all()
    assert np.isfinite(SurfaceGaps(rest, PAIR, np.repeat([0, 1], HALF), REACH).distances(rest)).sum() > 50


def test_a_block_that_is_pressed_flat_does_not_touch_itself():
    rest, flat = (block([0, 0, 0], [SIDE, SIDE, height]).vertices for height in (0.5 * SIDE, GAP))
    assert np.isinf(SurfaceGaps(rest, TRIANGLES, np.zeros(HALF, int), REACH).distances(flat)).all()
