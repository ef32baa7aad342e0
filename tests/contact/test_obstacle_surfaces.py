"""Obstacles whose surface meets surfaces of bodies: nothing crosses at rest, pressed or turned."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from block_scene import (
    DENSITY,
    GRAVITY,
    SIDES,
    G,
    block_scene,
    box_at,
    model_of,
    play,
    solid_of,
    write_scene,
)
from crossings import count_crossings, crossings
from one_process import input_error
from scipy.spatial.transform import Rotation
from test_contact import PRESSED, off_the_slide

from msmpetsc.build import Model
from msmpetsc.contact.step_contact import StepContactAt
from msmpetsc.contact.surface.obstacle_surfaces import ObstacleSurfaces
from msmpetsc.contact.surface.pairs import ContactSearch
from msmpetsc.contact.surface.surface_contact import SurfaceContact
from msmpetsc.fields import Frame
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.nonlinear.preconditioning import LatticePreconditioner

SOLID = solid_of(1e5, 0.3, damping=5.0)
FLOOR = box_at([[-1.03, -1.1, -0.2], [1.5, 1.6, -0.002]], response="barrier")
PLATE = box_at([[-0.2, -0.2, 0.26], [0.7, 0.7, 0.3]], response="barrier")
PLATE["path"] = [{"time": 0.5, "by": [0, 0, -0.06]}]
FOOT = [{"region": {"box": [[-1, -1, -1], [1, 1, 0.01]]}}]
WEIGHT = DENSITY * G * SIDES.prod()
ERROR = {"preset": "newton", "error": 1e-4}


def fine_block(folder: Path, **tables) -> Path:
    """Return a block whose surface has edges of 3 to 6 cm, about the size of a cell."""
    scene = block_scene(folder, **{"solver": ERROR, "material": SOLID, "output": {}} | tables)
    block = trimesh.creation.box(bounds=[[0, 0, 0], SIDES]).subdivide_to_size(0.1)
    block.export(folder / "scene.ply")
    return scene


def surfaces(model: Model) -> ObstacleSurfaces:
    assert model.collision is not None
    return model.collision.points.obstacles


def crossed(model: Model, frame: Frame) -> int:
    """Return the number of crossings of edges and triangles of bodies and obstacles.

    Triangles on one face of a turned obstacle may seem to cross each other by rounding.
    """
    obstacles, body = surfaces(model), model.surface
    assert body is not None and frame.surface is not None
    points, triangles, first = (
        [frame.surface, obstacles.points_at(frame.time)],
        [body.triangles],
        len(body.points),
    )
    for solid in obstacles.solids:
        triangles.append(solid.triangles + first)
        first += len(solid.points)
    of_obstacles = np.concatenate(triangles[1:]) - len(body.points)
    return count_crossings(np.concatenate(points), np.concatenate(triangles)) - count_crossings(
        points[1], of_obstacles
    )


def test_a_block_comes_to_rest_on_a_floor_that_carries_its_weight(tmp_path: Path):
    time = {"step": 0.02, "duration": 1.0}
    scene = fine_block(tmp_path, time=time, obstacle=[FLOOR], gravity=GRAVITY)
    model, frames = play(scene)
    last = frames[-1]
    assert not any(crossed(model, frame) for frame in frames)
    assert last.push[0] == pytest.approx([0, 0, WEIGHT], abs=0.01 * WEIGHT)
    np.testing.assert_allclose(last.contact_push[0], last.push[0], atol=1e-9 * WEIGHT)
    assert model.collision is not None
    assert 0 < last.self_distance < model.collision.law.distance
    assert max(frame.energy_gained for frame in frames) < 1e-3 * last.elastic
    # with starts beyond the floor it took 64
    assert sum(frame.iterations for frame in frames[-10:]) < 32


def test_a_plate_that_throws_a_block_gives_no_energy_from_nowhere(tmp_path: Path):
    """BDF2 spreads the plate's impulse over steps, in which the plate does no work."""
    plate = FLOOR | {"path": [{"time": 0.1, "by": [0, 0, 0.05]}]}
    time = {"step": 0.01, "duration": 0.1, "integrator": "bdf2"}
    scene = fine_block(tmp_path, time=time, obstacle=[plate], material=solid_of(1e5, 0.25))
    _, frames = play(scene)
    assert frames[-1].kinetic > 0
    assert sum(frame.energy_gained for frame in frames) < 1e-3 * frames[-1].kinetic


def test_frames_within_long_adaptive_steps_have_the_force_of_a_floor(tmp_path: Path):
    time = {"step": 0.02, "duration": 1.0, "error": 0.5}
    scene = fine_block(tmp_path, time=time, obstacle=[FLOOR], gravity=GRAVITY)
    frames = play(scene)[1][-6:]
    assert any(frame.steps == 0 for frame in frames)
    for frame in frames:
        assert frame.push[0, 2] == pytest.approx(WEIGHT, rel=0.2)
        np.testing.assert_allclose(frame.contact_push[0], frame.push[0], atol=1e-9 * WEIGHT)


def test_a_plate_presses_a_block_that_is_held_at_its_foot(tmp_path: Path):
    """A step moves the plate by many times the barrier's distance and carries near nodes along."""
    time = {"step": 0.05, "duration": 0.6}
    model, frames = play(fine_block(tmp_path, time=time, obstacle=[PLATE], pin=FOOT))
    assert not any(crossed(model, frame) for frame in frames)
    last = frames[-1]
    # upper bound: the barrier's distance takes a little of the compression
    pressed = 0.05 / SIDES[2]
    force = pressed * SOLID["young_modulus"] * SIDES[0] * SIDES[1]
    # stiffer than a bar, because the foot cannot spread
    assert force < -last.push[0, 2] < 2 * force
    assert last.reaction[0, 2] == pytest.approx(-last.push[0, 2], rel=0.01)


def test_a_plate_turns_as_its_path_says_and_pushes_a_block_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    prepare, free_but_pressed = LatticePreconditioner.prepare, []

    def noting(self: LatticePreconditioner, q: np.ndarray, contact: StepContactAt | None) -> bool:
        changed = prepare(self, q, contact)
        if contact:
            free_but_pressed.append(self.is_free and contact.surface.presses)
        return changed

    monkeypatch.setattr(LatticePreconditioner, "prepare", noting)
    box, center = [[0.55, 0.1, -0.1], [0.6, 0.4, 0.35]], [0.575, 1.0, 0.0]
    plate = box_at(box, response="barrier", center=center)
    plate["path"] = [{"time": 1.0, "by": [0, 0.1, 0], "turn": [0, 0, -90]}]
    time = {"step": 0.02, "duration": 0.3}
    solver = ERROR | {"preset": "newton-multigrid"}
    model, frames = play(fine_block(tmp_path, time=time, obstacle=[plate], solver=solver))
    matrix = trimesh.transformations.rotation_matrix(-0.3 * np.pi / 2, [0, 0, 1], center)
    expected = trimesh.transform_points(surfaces(model).solids[0].points, matrix) + np.array(
        [0, 0.03, 0]
    )
    np.testing.assert_allclose(surfaces(model).points_at(0.3), expected, atol=1e-14)
    assert not any(crossed(model, frame) for frame in frames)
    assert frames[-1].momentum[0] < -1.0
    assert free_but_pressed and not any(free_but_pressed), (
        "a body that an obstacle presses is not free to move away"
    )
    assert max(frame.energy_gained for frame in frames) < 0.01 * frames[-1].kinetic


@pytest.mark.parametrize("shape", ["sphere", "mesh"])
def test_a_ball_and_a_mesh_stop_what_falls_on_them(tmp_path: Path, shape: str):
    ball = {"shape": "sphere", "center": [0.25, 0.25, -0.31], "radius": 0.3, "response": "barrier"}
    if shape == "mesh":
        trimesh.creation.icosphere(radius=0.3).apply_translation(ball.pop("center")).export(
            tmp_path / "ball.ply"
        )
        ball = {"shape": "mesh", "mesh": {"source": "ball.ply"}, "response": "barrier"}
    time = {"step": 0.02, "duration": 0.4}
    scene = fine_block(tmp_path, time=time, obstacle=[ball], gravity=GRAVITY)
    model, frames = play(scene)
    assert not any(crossed(model, frame) for frame in frames)
    assert frames[-1].self_contacts > 0 and frames[-1].push[0, 2] > 0.1 * WEIGHT


@pytest.mark.parametrize(
    ("response", "pull", "young", "cells", "steps"),
    [
        ("barrier", 20.0, 1e5, 150, 10),
        ("penalty", 20.0, 1e5, 150, 10),
        # with contact of nodes alone it sinks in by half a cell, and a step takes
        # minutes
        pytest.param("barrier", 60.0, 5e4, 300, 40, marks=pytest.mark.slow),
    ],
)
def test_a_ball_pressed_into_a_hole_stays_on_its_rim(
    tmp_path: Path, response: str, pull: float, young: float, cells: int, steps: int
):
    """The edges of the hole hold the ball; contact of nodes alone lets the ball through."""
    trimesh.creation.annulus(0.045, 0.12, 0.06, sections=24).export(tmp_path / "washer.ply")
    washer = {
        "shape": "mesh",
        "mesh": {"source": "washer.ply", "base": [0, 0, -0.0605]},
        "response": response,
    }
    everywhere = {"half_space": {"point": [0, 0, -1], "normal": [0, 0, 1]}}
    pressed = {"region": everywhere, "total": [0, 0, -pull]}
    scene = fine_block(
        tmp_path,
        time={"step": 0.01, "duration": 0.01 * steps},
        material=SOLID | {"young_modulus": young},
        obstacle=[washer],
        force=[pressed],
        cages={"count": cells},
    )
    ball = trimesh.creation.icosphere(3, 0.06)
    ball.apply_translation([0, 0, 0.042]).export(tmp_path / "scene.ply")
    model, frames = play(scene)
    ring = trimesh.load(tmp_path / "washer.ply").apply_translation([0, 0, -0.0305])
    assert (crossings(model, frames, ring) == 0) == (response == "barrier")
    assert 0.25 * pull < frames[-1].push[0, 2] < 3 * pull


def test_a_block_that_turns_with_a_table_slips_by_nothing_in_a_step_of_bdf2(tmp_path: Path):
    """The slip of a block that turns with a table is zero.

    With the table's velocity at the middle of the step, blocks crept by w^2 r t / 2. The work of
    the table then took (w t)^2 of the block's energy a step.
    """
    t = 0.01
    table = box_at([[-1, -1, -0.2], [1, 1, -2e-4]], response="barrier", center=[0, 0, 0])
    table["path"] = [{"time": 1.0, "turn": [0, 0, 360]}]
    rough = {"distance": 1e-3, "friction": 0.5}
    time = {"step": t, "duration": 1.0, "integrator": "bdf2"}
    model = model_of(fine_block(tmp_path, time=time, self_contact=rough, obstacle=[table]))

    def turned(time: float) -> np.ndarray:
        return Rotation.from_rotvec([0, 0, 2 * np.pi * time]).apply(model.lattice.nodes)

    contacts = ContactSearch(model.collision)
    start = contacts.begin_step(turned(t), t, 2 * t)
    contact = SurfaceContact(contacts, start, t, turned(0))
    friction = contact.friction
    assert friction is not None and len(friction.pairs) > 10
    slip = friction.slip(contacts.points(turned(2 * t), 2 * t))[0]
    np.testing.assert_allclose(slip, 0, atol=1e-14)
    # Friction of blocks that slip outwards is across the velocity of the table.
    slipped = turned(2 * t) * [1 + 1e-4, 1 + 1e-4, 1]
    (force,), work = contact.at(slipped).of_obstacles()
    assert abs(work) < 2e-3 * np.linalg.norm(force[:2]) * 2 * np.pi * t


def error_of_a_slide(folder: Path, t: float) -> float:
    """Return the error [m] of X + mu Z, as in test_contact; it does not depend on the push."""
    mu = 0.2
    floor = FLOOR | {"box": [[-0.503, -0.507, -0.2], [1.5, 1.1, -1e-4]]}
    scene = block_scene(
        folder,
        time={"step": t, "duration": 0.2, "integrator": "bdf2"},
        force=PRESSED,
        obstacle=[floor],
        gravity=GRAVITY,
        start={"velocity": [2.0, 0, 0]},
        material={"young_modulus": 2e4, "density": DENSITY},
        self_contact={"distance": 1e-4, "friction": mu},
        solver=ERROR | {"error": 1e-6},
    )
    trimesh.creation.box(bounds=[[0, 0, 0], SIDES]).subdivide().subdivide().export(
        folder / "scene.ply"
    )
    return off_the_slide(*play(scene), mu, weight=WEIGHT)


@pytest.mark.slow
def test_friction_of_the_surface_is_of_second_order_with_bdf2(tmp_path: Path):
    """Errors are of second order, down to 2e-4 m, which edges of the floor's triangles cause.

    With the push of the start they were 7.0, 3.7 and 1.9 mm.
    """
    errors = [error_of_a_slide(tmp_path, t) for t in (0.01, 0.005, 0.0025)]
    assert errors[0] < 2.5e-3 and errors[1] < 0.5 * errors[0] and errors[2] < 0.4 * errors[1]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"box": [[-1, -1, -0.2], [1.5, 1.5, 0.01]]},
            "obstacle: a surface with a barrier cuts a body at rest, at (",
        ),
        ({"box": [[-1, -1, -0.2], [1.5, 1.5, -1e-9]]}, "from a body at rest"),
        (
            {"response": "penalty", "path": [{"time": 1.0, "turn": [0, 0, 90]}]},
            'has a path that turns, which is for response = "barrier" with a center',
        ),
        (
            {"path": [{"time": 1.0, "turn": [0, 0, 90]}]},
            'turns, which is for response = "barrier" with a center',
        ),
        ({"start": 0.1}, "that are there from the start"),
        ({"stop": 0.1}, "has stop, which is for"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, changes: dict, expected: str):
    scene = fine_block(tmp_path, time={"step": 0.02, "duration": 0.2}, obstacle=[FLOOR | changes])
    assert expected in input_error(lambda: play(scene))


def test_explicit_steps_refuse_it(tmp_path: Path):
    time = {"step": 0.02, "duration": 0.2, "integrator": "verlet"}
    scene = fine_block(tmp_path, time=time, obstacle=[FLOOR])
    assert 'obstacle: response = "barrier" is for' in input_error(lambda: load_scene(scene))


def ball_above(folder: Path, obstacle: dict, height: float = 0.0, scale: float = 1.0) -> Path:
    """Return a scene of a ball of 15 cm, its middle at a height [m], times a scale."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.15 * scale)
    ball.apply_translation([0, 0, height * scale])
    ball.export(folder / "scene.ply")
    return write_scene(
        folder,
        mesh={"source": "scene.ply"},
        cages={"count": 71},
        material=SOLID,
        time={"step": 0.01, "duration": 0.01},
        obstacle=[obstacle],
    )


def test_a_ball_whose_nodes_have_no_triangle_around_is_built(tmp_path: Path):
    """Some nodes of the ball are corners of cells that contain no triangle of the surface."""
    scene = ball_above(tmp_path, FLOOR, height=0.152)
    assert len(model_of(scene).lattice.cells) == 72


def test_balls_of_a_micrometre_have_the_triangles_of_balls_of_a_metre(tmp_path: Path):
    """No absolute length merges points of an obstacle."""
    counts = []
    for scale in (1.0, 1e-6):
        below = {"shape": "sphere", "center": [0, 0, -0.31 * scale], "radius": 0.15 * scale}
        scene = ball_above(tmp_path, below | {"response": "barrier"}, scale=scale)
        (obstacle,) = surfaces(model_of(scene)).solids
        counts.append((len(obstacle.points), len(obstacle.triangles)))
    assert counts[0] == counts[1]
