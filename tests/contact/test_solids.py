"""Spheres, meshes and functions as obstacles agree with planes, boxes and spheres."""

from pathlib import Path

import igl
import numpy as np
import pytest
import trimesh
from block_scene import GRAVITY, G, block_scene, box_at, model_of, plane_at, play
from conftest import result_on
from one_process import input_error
from surfaces import surface_of

import msmpetsc as msm
from msmpetsc.contact.obstacles.distance import FunctionSolid, MeshSolid
from msmpetsc.contact.obstacles.solids import Solid
from msmpetsc.extensions import OBSTACLES

TORUS = trimesh.creation.torus(1.0, 0.4, major_sections=24, minor_sections=12)
STAR = trimesh.creation.box((1, 2, 3)) + trimesh.creation.icosphere(2).apply_translation([3, 0, 0])
CUT = trimesh.boolean.difference(
    [trimesh.creation.box((2, 2, 2)), trimesh.creation.box((1, 1, 3))], engine="manifold"
)
CENTER, RADIUS = np.array([0.21, 0.25, -0.3]), 0.3
BALL = {"shape": "sphere", "center": CENTER.tolist(), "radius": RADIUS}
OWN = {"shape": "function", "function": "ball"}
FALLING = {"time": {"step": 0.01, "duration": 0.25}, "gravity": GRAVITY}


def ball(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the signed distances to BALL's surface, and their gradients."""
    out = x - CENTER
    far = np.linalg.norm(out, axis=1)
    return far - RADIUS, out / far[:, None]


@pytest.fixture(autouse=True)
def registered():
    """Register the function for the time of a test."""
    msm.register_obstacle("ball", ball)
    yield
    OBSTACLES._registered.clear()


def solid_of(mesh: trimesh.Trimesh) -> MeshSolid:
    return MeshSolid(surface_of(mesh))


@pytest.mark.parametrize("mesh", [TORUS, STAR, CUT, trimesh.creation.icosphere(3)])
def test_depths_are_igls_signed_distances(mesh: trimesh.Trimesh):
    """Depths agree with igl's signed distance by winding number, a different method.

    The meshes have inward and outward edges and several parts.
    """
    low, high = mesh.bounds
    x = np.random.default_rng(1).uniform(low - 0.3, high + 0.3, (3000, 3))
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_WINDING_NUMBER
    distance = igl.signed_distance(
        x, np.array(mesh.vertices), np.array(mesh.faces, np.int64), sign_type=kind
    )[0]
    depths, _ = solid_of(mesh).depths(x)
    near = ((x >= low) & (x <= high)).all(axis=1)
    np.testing.assert_allclose(depths[near], -distance[near], atol=1e-12)
    assert (depths[~near] < 0).all() and (depths[~near] >= -distance[~near] - 1e-12).all()
    assert 100 < (depths > 0).sum() < near.sum()


@pytest.mark.parametrize(
    "solid", [solid_of(TORUS), FunctionSolid(ball, "obstacle.0")], ids=["mesh", "function"]
)
def test_normals_are_the_slope_of_depths_and_a_small_change_keeps_its_digits(solid: Solid):
    rng = np.random.default_rng(2)
    x = rng.uniform(-1.4, 1.4, (4000, 3)) * 0.4 + (
        0 if isinstance(solid, FunctionSolid) else 0.8 * np.array([1, 0, 0])
    )
    depths, face = solid.depths(x)
    x, face, depths = x[depths > 1e-3], face[depths > 1e-3], depths[depths > 1e-3]
    normals, step = solid.normals(x, face), 1e-6
    slope = [
        (solid.depths(x + step * e)[0] - solid.depths(x - step * e)[0]) / (2 * step)
        for e in np.eye(3)
    ]
    off = np.abs(normals + np.array(slope).T).max(axis=1)
    # except where the nearest triangle changes
    assert len(x) > 30 and np.median(off) < 1e-8 and (off < 1e-4).mean() > 0.95
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    # a difference of depths would keep seven of its digits
    moved = 1e-9 * rng.normal(size=x.shape)
    np.testing.assert_allclose(
        solid.depth_change(x + moved, moved, face),
        -(moved * normals).sum(axis=1),
        rtol=1e-5,
        atol=1e-15,
    )
    far = x + 0.3 * depths[:, None] * rng.normal(size=x.shape)
    still = solid.depths(far)
    same = (still[0] > 0) & (still[1] == face)
    np.testing.assert_allclose(
        solid.depth_change(far[same], (far - x)[same], face[same]),
        (still[0] - depths)[same],
        atol=1e-12,
    )


@pytest.mark.parametrize("radius", [1e-2, 1e-6])
def test_fine_triangles_have_the_depths_of_large_triangles(radius: float):
    """Triangles of 0.4 mm, in a ball of 1 cm, and of 0.04 um."""
    mesh = trimesh.creation.icosphere(5)
    large, small = solid_of(mesh), solid_of(mesh.copy().apply_scale(radius))
    rng = np.random.default_rng(3)
    x = rng.normal(size=(500, 3))
    x *= rng.uniform(0.95, 0.98, (500, 1)) / np.linalg.norm(x, axis=1)[:, None]
    depths, face = large.depths(x)
    found, found_face = small.depths(radius * x)
    np.testing.assert_allclose(found, radius * depths, rtol=1e-9)
    moved = radius * 1e-3 * rng.normal(size=x.shape)
    np.testing.assert_allclose(
        small.normals(radius * x, found_face), large.normals(x, face), atol=1e-9
    )
    np.testing.assert_allclose(
        small.depth_change(radius * x, moved, face),
        radius * large.depth_change(x, moved / radius, face),
        atol=1e-12 * radius,
    )


def test_a_node_on_the_surface_has_its_triangles_normal_and_one_far_off_no_depth():
    cube = solid_of(trimesh.creation.box((1, 1, 1)))
    on_top, far = np.array([[0.1, 0.2, 0.5]]), np.array([[9.0, 0, 0]])
    depths, face = cube.depths(on_top)
    assert abs(depths[0]) < 1e-15 and cube.normals(on_top, face).tolist() == [[0, 0, 1]]
    assert cube.depths(far)[0][0] == -8.5
    assert cube.depths(np.empty((0, 3)))[0].shape == (0,)


PLATE = np.array([[-0.2, -0.2, -0.5], [0.7, 0.7, -0.02]])
# radius [m]: the surface sinks by 3e-7 m over the block, and depths are rounded to
# 1e-11 m
FLAT = 1e5
SPHERE = {"shape": "sphere", "center": [0.25, 0.25, -0.02 - FLAT], "radius": FLAT}
ROUGH = {"response": "penalty", "friction": 0.3}
MOVING = ROUGH | {"path": [{"time": 0.2, "by": [0.02, 0, 0.01]}]}
BOUNCING = {"response": "reflect", "restitution": 0.5}
# gravity that makes the block slide, and a step error with which pushes are as accurate
# as depths
SLIDING = {
    "time": {"step": 1 / 240, "duration": 0.15},
    "gravity": {"acceleration": [2.0, 0, -G]},
    "solver": {"preset": "newton", "error": 1e-6},
}
OBLIQUE = FALLING | {"start": {"velocity": [0.5, 0, -1]}}
# two descriptions of a solid, other tables of the scene, and the difference [m]
PAIRS = {"function": (BALL, OWN, FALLING, 2e-6), "flat": (plane_at(-0.02), SPHERE, SLIDING, 1e-4)}
MESH = {"shape": "mesh", "mesh": {"source": "plate.ply"}}


@pytest.mark.parametrize(
    ("pair", "integrator", "response"),
    [
        # a block slips off the top of a ball to one side
        ("function", "implicit-euler", MOVING),
        ("function", "bdf2", BOUNCING),
        ("function", "verlet", MOVING),
        # a block falls obliquely on a plate; faces that nodes entered by have no effect
        ("mesh", "implicit-euler", ROUGH | {"friction": 0.4}),
        ("flat", "implicit-euler", BOUNCING),
        ("flat", "bdf2", ROUGH),
        ("flat", "verlet", BOUNCING),
    ],
)
def test_two_descriptions_of_a_solid_give_the_same_run(
    tmp_path: Path, pair: str, integrator: str, response: dict
):
    trimesh.creation.box(bounds=PLATE).export(tmp_path / "plate.ply")
    pairs = PAIRS | {"mesh": (box_at(PLATE.tolist()), MESH, OBLIQUE, 1e-7)}
    *obstacles, tables, off = pairs[pair]
    tables = tables | {"time": tables["time"] | {"integrator": integrator}}
    moved = []
    for obstacle in obstacles:
        model, frames = play(block_scene(tmp_path, obstacle=[obstacle | response], **tables))
        moved.append(frames[-1].position - model.lattice.nodes)
    # the block has met the solid, bends and slides
    fall = 0.5 * G * tables["time"]["duration"] ** 2
    assert moved[0][:, 2].mean() > -0.5 * fall and np.ptp(moved[0], axis=0).max() > 1e-3
    np.testing.assert_allclose(moved[1], moved[0], atol=off)


def test_a_mesh_is_prepared_as_a_bodys_and_ranks_agree(tmp_path: Path):
    trimesh.creation.icosphere(3, radius=50).export(tmp_path / "statue.ply")
    mesh = {"source": "statue.ply", "size": 0.6, "base": [0.21, 0.25, -0.6]}
    obstacle = [{"shape": "mesh", "mesh": mesh, "response": "penalty"}]
    scene = block_scene(tmp_path, obstacle=obstacle, **FALLING)
    solid = model_of(scene).penalties[0].obstacle.solid
    np.testing.assert_allclose(solid.surface(None, None).points.mean(axis=0), CENTER, atol=1e-6)
    one, three = (result_on(ranks, scene) for ranks in (1, 3))
    np.testing.assert_allclose(three["frames/position"][-1], one["frames/position"][-1], atol=1e-7)
    assert one["frames/contact"][-1] > 0
    assert len(one["obstacle/triangles"]) == len(three["obstacle/triangles"]) == 1280


def test_the_surface_of_a_function_is_in_the_file(tmp_path: Path):
    """The file has the function's surface by marching cubes, to a cell of their grid.

    It has the number of its obstacle, and ends at the bottom of the grid.
    """
    plane = plane_at(-9)
    scene = block_scene(tmp_path, obstacle=[plane, OWN], **FALLING)
    with msm.open(msm.run(scene, tmp_path / "x.h5", quiet=True)) as result:
        points, numbers = result["obstacle/points"][:], result["obstacle/number"][:]
    assert set(numbers) == {1}
    far = np.linalg.norm(points - CENTER, axis=1)
    assert abs(far - RADIUS).max() < 0.02 and np.ptp(points, axis=0)[:2].min() > 0.59


def wrong(scale: float = 1.0, shape: int = 3, value: float = 0.0):
    return lambda x: (np.full(len(x), value), np.full((len(x), shape), scale / np.sqrt(3)))


MISTAKES = [
    ({"shape": "mesh"}, None, 'obstacle.0: needs mesh for shape = "mesh"'),
    ({"shape": "function"}, None, 'obstacle.0: needs function for shape = "function"'),
    ({**BALL, "function": "ball"}, None, "obstacle.0: has function, which is for 'function' only"),
    ({"shape": "mesh", "mesh": {"source": "gone.ply"}}, None, "gone.ply"),
    ({"shape": "mesh", "mesh": {"source": "open.ply"}}, None, "obstacle.0.mesh: must be closed"),
    (
        {"shape": "mesh", "mesh": {"source": "open.ply", "prepare": ["mend"]}},
        None,
        "obstacle.0.mesh.prepare.0: ",
    ),
    ({"shape": "function", "function": "bell"}, None, "no obstacle 'bell' is registered"),
    (OWN, wrong(2.0), "obstacle.0.function: no signed distance"),
    (OWN, wrong(value=np.nan), "obstacle.0.function: returned numbers that are not finite"),
    (OWN, lambda x: x[:, 0], "obstacle.0.function: returned no distances of shape"),
]


@pytest.mark.parametrize(("obstacle", "function", "said"), MISTAKES)
def test_mistakes_are_one_line(tmp_path: Path, obstacle: dict, function, said: str):
    ball = trimesh.creation.icosphere(1)
    ball.update_faces(np.arange(len(ball.faces)) > 0)
    ball.export(tmp_path / "open.ply")
    if function is not None:
        msm.register_obstacle("ball", function)
    scene = block_scene(tmp_path, obstacle=[obstacle], **FALLING)
    assert said in input_error(lambda: model_of(scene))
