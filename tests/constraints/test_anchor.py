"""Nodes that a scene moves and releases, and regions painted on the surface."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from block_scene import CELL, SIDES, block_scene, loop_of, play
from mpi4py import MPI
from one_process import answers_on, refusal_in

from msmpetsc.build import build_model, read_bodies
from msmpetsc.errors import InputError
from msmpetsc.scene.reading import load_scene

T = 0.01
LEFT = {"box": [[0, 0, 0], [0.01, 0.5, 0.25]]}
# 0.4 m/s; then 0.2 m/s sideways and upwards
UP = [
    {"time": 0.05, "by": [0, 0, 0.02]},
    {"time": 0.1, "by": [0, 0.01, 0.03]},
]


def place(path: list[dict], time: float) -> np.ndarray:
    """Return the position on a path at a time."""
    stops = [{"time": 0, "by": [0, 0, 0]}, *path]
    return np.array(
        [np.interp(time, [s["time"] for s in stops], [s["by"][c] for s in stops]) for c in range(3)]
    )


def anchored_scene(folder: Path, steps: int, anchors: list[dict], **tables) -> Path:
    return block_scene(folder, time={"step": T, "duration": steps * T}, anchor=anchors, **tables)


def test_anchored_nodes_are_on_their_path_and_the_others_follow(tmp_path: Path):
    model, frames = play(anchored_scene(tmp_path, 14, [{"region": LEFT, "path": UP}]))
    rest, mass = model.lattice.nodes, model.lattice.mass
    prescribed = rest[:, 0] == 0
    assert prescribed.sum() == 15
    for frame in frames:
        np.testing.assert_array_equal(
            frame.position[prescribed], rest[prescribed] + place(UP, frame.time)
        )
    others = (frames[-1].position - rest)[~prescribed]
    # the body swings about the end of the path
    assert 0.5 * 0.03 < mass[~prescribed] @ others[:, 2] / mass[~prescribed].sum() < 1.5 * 0.03
    assert np.linalg.norm(others, axis=1).min() > 0


def test_of_two_anchors_on_a_node_the_first_leads_it_and_a_pin_is_stronger_than_both(
    tmp_path: Path,
):
    low = {"box": [[0, 0, 0], [0.5, 0.5, 0.01]]}
    sideways = [{"time": 0.05, "by": [0.01, 0, 0]}]
    anchors = [{"region": LEFT, "path": UP}, {"region": low, "path": sideways}]
    pin = [{"region": {"box": [[0, 0, 0], [0.5, 0.01, 0.25]]}}]
    model, frames = play(anchored_scene(tmp_path, 5, anchors, pin=pin))
    rest, moved = model.lattice.nodes, frames[-1].position - model.lattice.nodes
    pinned = rest[:, 1] == 0
    first = (rest[:, 0] == 0) & ~pinned
    second = (rest[:, 2] == 0) & ~pinned & ~first
    np.testing.assert_array_equal(moved[pinned], 0)
    np.testing.assert_allclose(moved[first], np.tile([0, 0, 0.02], (first.sum(), 1)), atol=1e-15)
    np.testing.assert_allclose(moved[second], np.tile([0.01, 0, 0], (second.sum(), 1)), atol=1e-15)
    np.testing.assert_array_equal(model.lattice.pinned, pinned)


def test_let_go_a_body_keeps_the_momentum_that_its_path_gave_it(tmp_path: Path):
    """Released nodes keep the velocity of the path; without loads the momentum is then constant."""
    stop = 0.06 + 0.5 * T
    model, frames = play(anchored_scene(tmp_path, 15, [{"region": LEFT, "path": UP, "stop": stop}]))
    rest, mass = model.lattice.nodes, model.lattice.mass
    prescribed = rest[:, 0] == 0
    held, free = frames[6], frames[7]
    assert held.time < stop < free.time
    velocity = (held.position - frames[5].position) / T
    np.testing.assert_allclose(
        velocity[prescribed], np.tile([0, 0.2, 0.2], (prescribed.sum(), 1)), atol=1e-12
    )
    np.testing.assert_allclose(held.momentum, mass @ velocity, atol=1e-12)
    for frame in frames[7:]:
        np.testing.assert_allclose(frame.momentum, held.momentum, rtol=1e-6)
    assert (
        np.linalg.norm(free.position[prescribed] - rest[prescribed] - place(UP, free.time), axis=1)
        > 1e-5
    ).all()


def test_let_go_a_body_of_bdf2_does_not_go_on_with_the_anchor_s_force(tmp_path: Path):
    """The history of BDF2 holds the force, half a step of which once remained."""
    time = {"step": T, "duration": 15 * T, "integrator": "bdf2"}
    led = {"region": LEFT, "path": UP, "stop": 0.06 + 0.5 * T}
    _, frames = play(block_scene(tmp_path, time=time, anchor=[led]))
    for frame in frames[7:]:
        np.testing.assert_allclose(frame.momentum, frames[6].momentum, rtol=1e-6)


def test_every_node_held_is_refused_until_one_is_free(tmp_path: Path):
    anchors = [{"region": {"box": [[-1, -1, -1], [1, 1, z]]}, "path": UP} for z in (0.3, 0.2)]
    with pytest.raises(
        InputError, match="every node of the lattice is held, nothing is left to move"
    ):
        play(anchored_scene(tmp_path, 1, anchors[:1]))
    low = {"region": {"box": [[-1, -1, -1], [1, 1, 0.05]]}}
    high = {"region": {"box": [[-1, -1, 0.1], [1, 1, 1]]}, "path": UP}
    with pytest.raises(InputError, match="pin or anchor: every node"):
        play(anchored_scene(tmp_path, 1, [high], pin=[low]))
    play(anchored_scene(tmp_path, 1, anchors[1:]))


def test_a_wrong_option_is_still_told_where_the_solver_was_built_again(
    tmp_path: Path, petsc_options
):
    """An option that only the first solver used is not reported, nor removed with our defaults."""
    scene = anchored_scene(tmp_path, 3, [{"region": LEFT, "path": UP, "stop": 0.015}])
    petsc_options(ksp_rtol="1e-8")
    with loop_of(scene) as simulation:
        first = simulation.integrator.stepper
        assert len(list(simulation.frames())) == 4
        second = simulation.integrator.stepper
        assert second is not first and second.ksp.getTolerances()[0] == 1e-8
        simulation.refuse_unused_options(at_end=True)
        petsc_options(ksp_tpye="cg")
        with pytest.raises(InputError, match="-ksp_tpye"):
            simulation.refuse_unused_options(at_end=True)


# ---- painted regions

PAINTED = [3, 17, 3, 101]


@pytest.fixture(scope="module")
def balls(tmp_path_factory) -> Path:
    """Return a folder with the scene of a ball, its painted pin, and files of point numbers."""
    folder = tmp_path_factory.mktemp("painted")
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1)
    ball.export(folder / "ball.ply")
    (folder / "numbers.txt").write_text("3 17\n3\n\n  101\n")
    (folder / "words.txt").write_text("3 17 left\n")
    (folder / "negative.txt").write_text("3 -1\n")
    (folder / "binary.txt").write_bytes(bytes(range(256)))
    (folder / "scene.toml").write_text(
        """
        mesh.source = "ball.ply"
        cages.cell_size = 0.3
        material = { young_modulus = 1e5, density = 1000, law = "linear" }
        time = { step = 0.01, duration = 0.01 }
        pin = [{ region.painted = [3, 17, 3, 101] }]
        """
    )
    return folder


def corners_of_cells_of(
    points: np.ndarray, low: np.ndarray, cell_size: float
) -> set[tuple[int, ...]]:
    """Return the grid indices of the corners of the cells that contain the points."""
    cells = ((points - low) // cell_size).astype(int)
    corners = cells[:, None] + np.array([*np.ndindex(2, 2, 2)])
    return set(map(tuple, corners.reshape(-1, 3).tolist()))


def test_painted_points_mean_the_corners_of_their_cells(balls: Path):
    scene = load_scene(balls / "scene.toml")
    model = build_model(MPI.COMM_SELF, scene)
    points = model.surface.points
    wanted = corners_of_cells_of(points[PAINTED], points.min(axis=0), 0.3)
    place = np.rint((model.lattice.nodes - points.min(axis=0)) / 0.3).astype(int)
    found = {tuple(p) for p in place[model.lattice.pinned].tolist()}
    assert found == wanted and 8 < len(found) <= 24
    from_file = build_model(
        MPI.COMM_SELF, load_scene(balls / "scene.toml", ["pin.0.region.painted=numbers.txt"])
    )
    np.testing.assert_array_equal(from_file.lattice.pinned, model.lattice.pinned)


def test_a_point_on_the_far_side_is_in_the_last_cell(tmp_path: Path):
    """The far faces of a block that lies along the grid belong to its last cells."""
    path = block_scene(
        tmp_path, time={"step": T, "duration": T}, pin=[{"region": {"painted": [0]}}]
    )
    scene = load_scene(path)
    points = read_bodies(MPI.COMM_SELF, scene)[0].surface.points
    far = int(np.argmax(points.sum(axis=1)))
    lattice = build_model(
        MPI.COMM_SELF, load_scene(path, [f"pin.0.region.painted=[{far}]"])
    ).lattice
    last = (lattice.nodes >= SIDES - CELL).all(axis=1)
    np.testing.assert_array_equal(lattice.pinned, last)
    assert last.sum() == 8


WRONG = {
    "[3, 162]": ["pin.0.region.painted", "there is no point 162", "162"],
    "gone.txt": ["gone.txt must be a file of point numbers"],
    "words.txt": ["words.txt must be a file of point numbers"],
    "negative.txt": ["negative.txt must be a file of point numbers"],
    "binary.txt": ["binary.txt must be a file of point numbers"],
    "[3, -1]": ["pin.0.region.painted", "point numbers, from 0"],
}


def test_what_cannot_be_painted_is_told_in_one_line_by_one_of_two_ranks(balls: Path):
    words = ["run", balls / "scene.toml", "-o", balls / "wrong.h5", "--set"]
    commands = [[*words, f"pin.0.region.painted={value}"] for value in WRONG]
    for told, answers in zip(WRONG.values(), answers_on(2, commands), strict=True):
        line = refusal_in(answers)
        assert all(word in line for word in told), line
    assert not list(balls.glob("wrong*"))
