"""Bodies in contact do not cross, keep their momentum and come to rest on each other."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
from block_scene import GRAVITY, ROUGH_GROUND, loop_of, model_of, play, solid_of, write_scene
from conftest import run
from crossings import crossings

import msmpetsc.contact.surface.pairs
from msmpetsc.contact.surface.barrier import Barrier, BarrierLaw
from msmpetsc.contact.surface.pairs import LEFT_OUT, ContactSearch
from msmpetsc.environment import Environment
from msmpetsc.errors import InputError
from msmpetsc.geometry.surface import Surface
from msmpetsc.solve.integrators.implicit import ContactFaces
from msmpetsc.solve.nonlinear.curvature import Alarm
from msmpetsc.solve.nonlinear.error_control import Outcome
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.newton import Newton

CELL, SIDE, DISTANCE, G = 0.05, 0.2, 1e-3, 9.81
SOLID = solid_of(1e5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("touching")
    trimesh.creation.box([SIDE, SIDE, SIDE]).subdivide().subdivide().export(folder / "block.ply")
    trimesh.creation.icosphere(subdivisions=2, radius=SIDE / 2).export(folder / "ball.ply")
    return folder


def body(mesh: str, base: list[float], **tables: Any) -> dict[str, Any]:
    return {"mesh": {"source": f"{mesh}.ply", "base": base}, **tables}


def write(folder: Path, name: str, **tables: Any) -> Path:
    """Write the scene file of bodies in contact; ``tables`` replace or extend its tables."""
    scene = {
        "cages": {"cell_size": CELL},
        "material": SOLID,
        "self_contact": {"distance": DISTANCE, "friction": 0.5},
        "solver": {"preset": "newton", "error": 1e-4},
    }
    return write_scene(folder, name, **scene | tables)


def pile(folder: Path, meshes: list[str], gap: float) -> Path:
    """Return the scene of a block on a pinned block, with a distance [m] between them."""
    pin = [{"region": {"box": [[0, 0, 0], [1, 1, 0.1]], "relative": True}}]
    bodies = [body(meshes[0], [0, 0, 0], pin=pin), body(meshes[1], [0, 0, SIDE + gap])]
    time, gravity = {"step": 0.01, "duration": 0.1}, GRAVITY
    return write(folder, "pile", body=bodies, time=time, gravity=gravity)


@pytest.mark.parametrize("meshes", [["block", "block"], ["block", "inward"], ["inward", "block"]])
def test_a_block_that_touches_another_at_rest_lies_on_it(folder: Path, meshes: list[str]):
    mesh = trimesh.load(folder / "block.ply")
    mesh.invert()
    mesh.export(folder / "inward.ply")
    model, frames = play(pile(folder, meshes, 0.0))
    upper = model.lattice.body == 1
    sunk, free = (frames[0].position - frames[-1].position)[upper].mean(axis=0), 0.5 * G * 0.1**2
    assert abs(sunk[:2]).max() < 1e-4 and -DISTANCE < sunk[2] < 0.2 * free


def test_cubes_side_by_side_in_the_same_plane_of_the_grid_stay_where_they_are(folder: Path):
    """The default gap must exceed the rounding of a coordinate to a plane of the grid."""
    bodies = [body("block", [number * SIDE, 0, 0]) for number in range(2)]
    tables = {"time": {"step": 0.01, "duration": 0.03}, "gravity": {"acceleration": [0, 0, 0]}}
    model, frames = play(write(folder, "side_by_side", body=bodies, self_contact={}, **tables))
    assert model.collision is not None
    assert abs(frames[-1].position - frames[0].position).max() < model.collision.law.distance


def test_bodies_that_overlap_at_rest_are_named(folder: Path):
    with pytest.raises(
        InputError, match=r"cut others at rest.* \(of body\.0, body\.1, which must be moved apart"
    ):
        play(pile(folder, ["block", "block"], -0.1 * SIDE))


def fall(folder: Path, name: str, height: float, **tables: Any) -> Path:
    """Return the scene of a ball that falls from a height [m] on a block on the ground."""
    bodies = [body("block", [0, 0, 0]), body("ball", [0.02, 0.01, SIDE + height])]
    # Springs come to rest sooner than a solid.
    tables = {
        "material": SOLID | {"law": "linear"},
        "gravity": GRAVITY,
    } | tables
    return write(folder, name, body=bodies, obstacle=[ROUGH_GROUND], **tables)


def test_a_solid_ball_lands_on_its_lowest_cells_which_are_slivers(folder: Path):
    """The ball lands without recovery.

    A direction bent at the ground once led uphill, and no line search could go on.
    """
    tables = {"material": SOLID, "time": {"step": 0.01, "duration": 0.15}}
    model, frames = play(fall(folder, "solid", 0.02, **tables))
    assert max(frame.self_contacts for frame in frames) > 20 and frames[-1].substeps == 0
    assert crossings(model, frames) == 0


@pytest.mark.parametrize(
    "turned", [np.eye(3), np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]]
)
@pytest.mark.parametrize("bent", [0.0, 0.01])
def test_what_comes_near_on_a_way_that_squeezes_all_is_among_its_pairs(
    turned: np.ndarray, bent: float
):
    """Boxes around paths leave out the linear part of the motion.

    The boxes still contain the pairs that come near only by the linear part.
    """
    rng = np.random.default_rng(0)
    plates = [trimesh.creation.box([SIDE, SIDE, 0.01]).subdivide().subdivide() for _ in range(2)]
    plates[1].apply_translation([0.003, 0.005, 0.01 + 1.15 * 0.02])
    points, triangles = np.concatenate([p.vertices for p in plates]), plates[0].faces
    triangles = np.concatenate([triangles, len(plates[0].vertices) + triangles])
    moved = (
        points @ np.diag([0.05, 0.02, -0.18])
        + bent * rng.uniform(-1, 1, points.shape)
        + [0.3, 0.1, -0.2]
    )
    points, moved = points @ turned.T, moved @ turned.T
    barrier = Barrier(Surface(points, triangles), BarrierLaw(0.02, 1.0, 0.0, 0.0), len(points))
    on_way, reach = barrier.candidates(points, 1e-3, moved), 1e-3
    for share in np.linspace(0, 1, 6):
        at = points + share * moved + reach / 2 * rng.uniform(-1, 1, points.shape)
        pushes = [
            barrier.gradient(barrier.contacts(pairs, at), at)
            for pairs in (on_way, barrier.candidates(at, 0.0))
        ]
        np.testing.assert_allclose(*pushes, atol=1e-12 * np.abs(pushes[1]).max())
    assert np.abs(pushes[1]).max() > 0


def test_a_way_is_cut_where_pairs_are_known_at_its_end_alone(folder: Path):
    """Collision detection finds a corner on the path even if the pairs at its end are cached."""
    scene = fall(folder, "way", 0.02, time={"step": 0.01, "duration": 0.01})
    model = model_of(scene)
    assert model.collision is not None
    start = model.lattice.nodes.copy()
    end = start - np.where(model.lattice.body[:, None] == 1, [0, 0, 0.02 + 2.5 * SIDE], 0.0)
    contacts = ContactSearch(model.collision)
    contacts.find(start)
    contacts.find(end)
    free = 0.02 / (0.02 + 2.5 * SIDE)
    # collision detection keeps a tenth of the collision-free path as distance
    assert 0.75 * free < contacts.collision_free_step(start, end) < free


def test_a_ball_that_falls_on_a_block_comes_to_rest_on_it(folder: Path):
    model, frames = play(fall(folder, "fall", 0.02, time={"step": 0.01, "duration": 0.4}))
    assert crossings(model, frames) == 0
    contacts = np.array([frame.self_contacts for frame in frames])
    first = int(np.argmax(contacts > 0))
    # free fall by 2 cm takes 64 ms
    assert 5 <= first <= 7 and (contacts[-20:] > 0).all()
    assert (
        0 < min(frame.self_distance for frame in frames[first:] if frame.self_contacts) < DISTANCE
    )
    assert frames[-1].kinetic < 0.02 * max(frame.kinetic for frame in frames)
    ball, mass = model.lattice.body == 1, model.lattice.mass
    height = np.array([mass[ball] @ frame.position[ball, 2] for frame in frames]) / mass[ball].sum()
    # the ball stays above the block, which is hardly dented
    assert height[first:].min() > SIDE and height[-1] > SIDE + 0.8 * SIDE / 2


def test_an_iteration_after_negative_curvature_is_projected_with_a_new_hierarchy(
    folder: Path, monkeypatch: pytest.MonkeyPatch
):
    """Other rules closed and opened the gap of a pair up to 2,006 times in a step."""
    events = list[tuple[str, bool, bool]]()

    def linearise(self, now, is_true, projected) -> None:
        linearised(self, now, is_true, projected)
        events.append(("system", projected, self.jacobian.preconditioner.is_new))

    def solve(self, now, outcome, tells_error) -> Outcome:
        result = solved(self, now, outcome, tells_error)
        is_new = self.jacobian.preconditioner.is_new
        events.append(("solve", result.alarm is Alarm.HERE, is_new))
        return result

    linearised, solved = Newton._linearise, Newton._solve
    monkeypatch.setattr(Newton, "_linearise", linearise)
    monkeypatch.setattr(Newton, "_solve", solve)
    tables = {"material": solid_of(1e4), "time": {"step": 0.01, "duration": 0.15}}
    play(fall(folder, "curved", 0.02, solver={"preset": "newton-multigrid"}, **tables))
    pairs = [pair for pair in pairwise(events) if pair[0][0] == "solve"]
    after = [(was_new, then) for (_, met, was_new), then in pairs if met]
    assert any(not was_new for was_new, _ in after)
    for was_new, (_, projected, is_new) in after:
        assert projected and is_new != was_new


@pytest.fixture
def solves(monkeypatch: pytest.MonkeyPatch) -> dict[int, list[str]]:
    """Return for each solve of each step of 10 ms the contacts that it used: none, known or all."""
    found: dict[int, list[str]] = {}
    problem = ContactFaces.problem

    def seen(self: ContactFaces) -> StepProblem:
        contacts = self.environment.contacts
        assert contacts is not None
        asked = "nothing" if contacts.is_left_out else "known" if contacts.is_narrow else "all"
        found.setdefault(round(self.time / 0.01), []).append(asked)
        return problem(self)

    monkeypatch.setattr(ContactFaces, "problem", seen)
    return found


@pytest.mark.parametrize(("few", "asked"), [(0.0, "all"), (1.0, "known")])
def test_the_surface_is_asked_about_around_what_touches_alone(
    folder: Path, solves, monkeypatch, few, asked
):
    """A step uses the pairs around contacts, and is repeated if it leads into further contacts.

    The frames are those of steps that search all pairs at each iterate.
    """
    monkeypatch.setattr(msmpetsc.contact.surface.pairs, "FEW", few)
    scene = fall(folder, "apart", 0.02, time={"step": 0.01, "duration": 0.15})
    _, frames = play(scene, "solver.error=1e-8")
    touching = [frame.self_contacts > 0 for frame in frames]
    assert [solves[i][0] for i in range(1, 16)] == [
        asked if touched else "nothing" for touched in touching[:-1]
    ]
    assert [solves[i][-1] == "nothing" for i in range(1, 16)] == [
        not any(both) for both in pairwise(touching)
    ]
    assert max(map(len, solves.values())) > 1
    with monkeypatch.context() as patch:
        patch.setattr(Environment, "begin_contacts", begun_with_all)
        for one, other in zip(frames, play(scene, "solver.error=1e-8")[1], strict=True):
            np.testing.assert_allclose(one.position, other.position, atol=1e-7 * SIDE)
            assert one.self_contacts == other.self_contacts


def begun_with_all(self: Environment, q: np.ndarray, time: float, time_step: float) -> None:
    assert self.contacts is not None
    self.contacts.begin_step(q, max(time - time_step, 0.0), time)


def test_what_stores_too_little_to_count_may_be_left_out(folder: Path, monkeypatch):
    monkeypatch.setattr(msmpetsc.contact.surface.pairs, "FEW", 1.0)
    scene = fall(folder, "light", 0.002, time={"step": 0.01, "duration": 0.01})
    model = model_of(scene)
    assert model.collision is not None
    contacts, start = ContactSearch(model.collision), model.lattice.nodes
    end = start - np.where(model.lattice.body[:, None] == 1, [0, 0, 0.002 - 0.5 * DISTANCE], 0.0)
    begun = contacts.begin_step(start, 0.0, 0.01)
    energy = contacts.summary(contacts.find(end)).energy
    for left_out, is_right in ((1.01, True), (0.99, False)):
        contacts.narrow(begun)
        assert contacts.is_left_out
        assert contacts.settle(None, end, left_out * energy / LEFT_OUT) == (is_right, True)
        assert not (contacts.is_narrow or contacts.is_left_out)
    assert contacts.summary(contacts.end).energy == pytest.approx(energy)
    assert contacts.settle(contacts.end, end, 0.0) == (True, True)


def test_a_step_past_what_it_would_meet_is_solved_with_the_surface(
    folder: Path, solves: dict[int, list[str]]
):
    """The path reveals a contact, although nothing touches at the end of the step."""
    bodies = [
        body("block", [0, 0, 0]),
        body("ball", [0.02, 0.01, SIDE + 0.02], start={"velocity": [0, 0, -50.0]}),
    ]
    play(write(folder, "past", body=bodies, time={"step": 0.01, "duration": 0.01}))
    assert solves[1] == ["nothing", "all"]


def test_a_correction_through_the_surface_says_little_of_the_error(folder: Path):
    """A flying ball's Newton correction leads through a block that the Hessian lacks."""
    bodies = [
        body("block", [0, 0, 0]),
        body("ball", [0, 0, SIDE + 0.002], start={"velocity": [0, 0, -5.0]}),
    ]
    # the velocity and gravity each move the ball by 5 cm
    time, gravity = (
        {"step": 0.01, "duration": 0.01},
        {"acceleration": [0, 0, -500.0]},
    )
    with loop_of(write(folder, "through", body=bodies, time=time, gravity=gravity)) as simulation:
        environment, state = simulation.environment, simulation.state
        stepper = simulation.integrator.stepper
        functional, optimality, q = stepper.functional, stepper.optimality, state.q
        y, load = 2 * q - state.q_previous, environment.forces.at(0.01)
        faces = ContactFaces(environment, q, y, load, 0.01, 0.01, None, stepper.lattice.pinned)
        environment.contacts.widen()
        functional.begin(faces.problem())
        now = functional.at(q)
        stepper.control.estimate(now)
        correction = stepper.control.estimate.correction_norm
        outcome = Outcome(corrected=True, compression=optimality.curvature.compression(now))
        verdict = optimality.examine(now, outcome, correction)
    assert verdict.error > 10 * correction / functional.distance(q)


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_blocks_that_collide_in_space_keep_their_momentum(folder: Path, friction: float):
    bodies = [body("block", [0, 0, 0], start={"velocity": [0, 0, 1.0]})]
    bodies += [body("block", [0.05, 0.08, SIDE + 0.012], start={"velocity": [0.2, 0, -0.5]})]
    contact = {"distance": DISTANCE, "friction": friction}
    path = write(
        folder,
        f"space{friction}",
        body=bodies,
        self_contact=contact,
        time={"step": 0.005, "duration": 0.1},
    )
    model, frames = play(path, "solver.error=1e-9")
    assert max(frame.self_contacts for frame in frames) > 10 and crossings(model, frames) == 0
    momentum = np.array([frame.momentum for frame in frames])
    mass = model.lattice.mass
    scale = 1.0 * mass[model.lattice.body == 0].sum()
    assert np.abs(momentum - momentum[0]).max() < 1e-7 * scale
    lower = model.lattice.body == 0
    speed = mass[lower] @ (frames[-1].position - frames[-2].position)[lower, 2] / 0.005 / scale
    # the other body takes much of the 1 m/s
    assert speed < 0.7


def test_on_three_ranks_they_end_as_on_one(folder: Path):
    tight = {"preset": "newton", "error": 1e-9}
    path = fall(folder, "ranks", 0.002, time={"step": 0.01, "duration": 0.04}, solver=tight)
    _, frames = play(path)
    words = "run", path, "-o", path.with_suffix(".h5")
    # numpy warns of the mean of no points, which ranks above 0 have
    assert "Warning" not in run(3, "-m", "msmpetsc.cli.main", *words, status=0).stderr
    three = h5py.File(path.with_suffix(".h5"))
    assert (three["frames/self_contacts"][-2:] > 0).all()
    expected, rest = np.array([frame.position for frame in frames]), three["lattice/nodes"][:]
    assert np.abs(three["frames/position"] - expected).max() < 1e-6 * np.abs(expected - rest).max()
