"""A surface that meets itself in a crease, with parts nearer at rest than the barrier's distance.

At rest the parts do not push. They never cross, and pairs that are left out are reported.
"""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from block_scene import block_scene, play, solid_of
from crossings import count_crossings

from msmpetsc.contact.surface.barrier import Barrier, BarrierLaw, ContactSets
from msmpetsc.contact.surface.continuous_collision import collision_free_step
from msmpetsc.geometry.surface import Surface

# sizes of a block, of the groove's bottom, and its half width [m]
LONG, HIGH, BOTTOM, HALF = (
    0.5,
    0.25,
    0.0625,
    0.07,
)
# distance of the barrier [m], more than the width of the groove
DISTANCE = 0.15
LAW = BarrierLaw(DISTANCE, 100.0, 0.5, 0.01)


def grooved(half: float = HALF) -> trimesh.Trimesh:
    """Return a block with a groove across its upper side; all points are within three rings."""
    low, high = LONG / 2 - half, LONG / 2 + half
    profile = [
        [LONG / 2, BOTTOM],
        [low, HIGH],
        [0, HIGH],
        [0, 0],
        [LONG, 0],
        [LONG, HIGH],
        [high, HIGH],
    ]
    near, far = (np.insert(profile, 1, y, axis=1) for y in (0.0, 0.25))
    fan = np.array([[0, i, i + 1] for i in range(1, 6)])
    i, j = np.arange(7), np.roll(np.arange(7), -1)
    sides = np.concatenate([np.stack([i, i + 7, j], 1), np.stack([j, i + 7, j + 7], 1)])
    mesh = trimesh.Trimesh(
        np.concatenate([near, far]), np.concatenate([fan, 7 + fan[:, ::-1], sides]), process=False
    )
    mesh.fix_normals()
    return mesh


def barrier_of(half: float = HALF) -> tuple[Barrier, np.ndarray, int]:
    """Return a grooved block's barrier, its points (14, 3), and the number of pairs left out."""
    mesh = grooved(half)
    points = np.array(mesh.vertices)
    barrier = Barrier(Surface(points, np.array(mesh.faces)), LAW, len(points))
    return barrier, points, barrier.leave_out_neighbours(points)


def closed(points: np.ndarray, gap: float) -> np.ndarray:
    """Return the points with the groove's upper edges at a distance ``gap`` [m]."""
    moved = points.copy()
    upper = np.isclose(np.abs(points[:, 0] - LONG / 2), HALF)
    moved[upper, 0] = LONG / 2 + np.sign(points[upper, 0] - LONG / 2) * gap / 2
    return moved


def test_nothing_pushes_in_a_crease_at_rest_and_its_walls_do_not_meet():
    barrier, points, dropped = barrier_of()
    assert len(barrier.creases) > 1 and dropped == 0
    candidates = barrier.candidates(points, 0.0)
    assert all(pairs.empty() for pairs in barrier.contacts(candidates, points))
    # the distance of 0.15 m over a power of 4, at most half of the 0.14 m between the
    # upper edges
    tight = DISTANCE / 4
    level = barrier.distances.index(tight)
    # pairs of walls push below this smaller distance
    assert barrier.contacts(barrier.creases, closed(points, 1.1 * tight))[level].empty()
    assert not barrier.contacts(barrier.creases, closed(points, 0.99 * tight))[level].empty()
    through = closed(points, -2 * HALF) - points
    # the sides meet halfway
    assert 0.3 < collision_free_step(barrier, points, through, candidates) < 0.5
    assert 0.3 < collision_free_step(barrier, points, through) < 0.5
    assert 0.3 < collision_free_step(barrier, points, through, barrier.creases) < 0.5
    assert collision_free_step(barrier, points, closed(points, 0.05) - points, candidates) == 1


def test_the_derivatives_in_a_crease_are_those_of_its_energy():
    barrier, points, _ = barrier_of()
    points = closed(points, DISTANCE / 10)
    # no edges are parallel
    points[:7] += 1e-3 * np.random.default_rng(1).normal(size=(7, 3))
    direction = np.random.default_rng(0).normal(size=points.shape)
    candidates, step = barrier.candidates(points, 0.01), 1e-7

    def at(share: float) -> tuple[ContactSets, np.ndarray]:
        moved = points + share * step * direction
        return barrier.contacts(candidates, moved), moved

    slope = (barrier.energy(*at(1)) - barrier.energy(*at(-1))) / (2 * step)
    gradient = barrier.gradient(*at(0))
    assert (
        slope == pytest.approx(np.vdot(gradient, direction), rel=1e-5)
        and np.abs(gradient).max() > 0
    )
    bend = (barrier.gradient(*at(1)) - barrier.gradient(*at(-1))) / (2 * step)
    around = barrier.around(gradient.any(axis=1), points, 0.01)
    np.testing.assert_allclose(
        barrier.gradient(barrier.contacts(around, points), points), gradient, rtol=1e-12
    )
    product = sum(barrier.hessian(*at(0), False)) @ direction.ravel()
    np.testing.assert_allclose(product, bend.ravel(), atol=1e-5 * np.abs(product).max())
    assert 0 < barrier.least(barrier.contacts(candidates, points), points) < DISTANCE / 4


def test_walls_that_all_but_touch_are_left_out_and_counted():
    # the walls are nearer than a thousandth of the distance
    assert barrier_of(half=0.4e-3 * DISTANCE)[2] > 0


def scene(folder: Path, **tables) -> Path:
    """Return the scene of the block; forces close its groove."""
    half = {"relative": True}
    sides = [[[0, 0, 0.6], [0.2, 1, 1]], [[0.8, 0, 0.6], [1, 1, 1]]]
    path = block_scene(
        folder,
        cages={"cell_size": 1 / 32},
        material=solid_of(1e5),
        time={"step": 0.02, "duration": 0.4},
        pin=[{"region": {"box": [[0.3, 0, 0], [0.7, 1, 0.2]]} | half}],
        force=[
            {"region": {"box": box} | half, "total": [sign * 250.0, 0, 0]}
            for box, sign in zip(sides, (1, -1), strict=True)
        ],
        solver={"preset": "newton", "error": 1e-4},
        **tables,
    )
    grooved().export(folder / "scene.ply")
    return path


def test_a_groove_that_is_pressed_shut_does_not_cross(tmp_path):
    model, frames = play(scene(tmp_path, self_contact={"distance": DISTANCE, "friction": 0.3}))
    triangles = model.collision.surface.triangles
    assert (
        sum(
            count_crossings(model.collision.points(frame.position, 0.0), triangles)
            for frame in frames
        )
        == 0
    )
    assert frames[0].self_contacts == 0 and max(frame.self_contacts for frame in frames) > 0
    assert 0 < min(frame.self_distance for frame in frames if frame.self_contacts) < DISTANCE / 4
    _, without = play(scene(tmp_path))
    assert count_crossings(model.collision.points(without[-1].position, 0.0), triangles) > 0
