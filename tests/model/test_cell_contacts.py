"""A surface that cuts itself all over at rest: its points are pushed out of other parts' cells."""

import copy
from pathlib import Path

import numpy as np
import pytest
import trimesh
from block_scene import play
from mpi4py import MPI
from pinch import ARM, HALF, RADIUS, pinch_scene, u_tube

from msmpetsc import open as msmpetsc_open
from msmpetsc.model.build import Model, build_model
from msmpetsc.model.self_contact.cell_contacts import CellContacts, OverlappingSurface
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve import simulate
from msmpetsc.solve.simulate import Simulation

COMM = MPI.COMM_SELF
CELL, DEEP = 0.0125, 0.006  # [m]; that the arms are in each other
MATERIAL = {"young_modulus": 1e5, "density": 1000, "law": "stiffening"}
pytestmark = pytest.mark.timeout(200)


def double_skin(folder: Path, **tables) -> Path:
    """The pinch of a U of tube that has two skins, which cut each other everywhere."""
    left, right = ({"box": [[x, 0, 0.7], [x + 0.3, 1, 1]], "relative": True} for x in (0, 0.7))
    forces = [{"region": left, "total": [6.0, 0, 0]}, {"region": right, "total": [-6.0, 0, 0]}]
    given = {"cages": {"cell_size": CELL, "boundary": "whole"}, "force": forces, "material": MATERIAL}
    path = pinch_scene(folder, **given | tables)
    trimesh.util.concatenate([u_tube(), u_tube(around=15, along=57)]).export(folder / "u.ply")
    return path


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Model:
    return build_model(COMM, load_scene(double_skin(tmp_path_factory.mktemp("skins"))))


@pytest.fixture
def contacts(model) -> CellContacts:
    assert isinstance(model.collision, OverlappingSurface)
    return CellContacts(COMM, model.collision)


def closed(model: Model, deep: float = DEEP) -> np.ndarray:
    """Nodes (n, 3) of the tube with its arms shifted together, so that their straight parts are so deep [m] in each
    other."""
    q = model.lattice.nodes.copy()
    end = np.clip(q[:, 2] / (0.4 * ARM), 0, 1)
    q[:, 0] -= np.sign(q[:, 0]) * (HALF - RADIUS + deep / 2) * end
    return q


def test_it_is_told(tmp_path, caplog):
    build_model(COMM, load_scene(double_skin(tmp_path)))
    assert "too many to do without: its points are pushed out of other parts' cells instead" in caplog.text
    assert caplog.text.count("triangles cut others at rest, the first at (") == 1


def test_nothing_is_pushed_at_rest_nor_turned_as_a_whole(model, contacts):
    q = model.lattice.nodes
    turn = trimesh.transformations.rotation_matrix(1.0, [1, 2, 3])[:3, :3]
    for still in (q, q @ turn.T + 0.7, closed(model, -0.01)):
        assert contacts.touch(still).contacts == 0 and not contacts.during(still).presses(still)


def test_points_are_as_deep_as_the_arms_are_in_each_other(model, contacts):
    """In a rigid shift of one arm a point's depth is its distance from the other's surface, but for the cells' size."""
    touch = contacts.touch(closed(model))
    assert touch.contacts > 10
    assert -touch.distance == pytest.approx(DEEP, abs=0.15 * CELL)
    less = contacts.touch(closed(model, DEEP - 0.002))
    assert less.distance - touch.distance == pytest.approx(0.002, rel=0.2)
    assert less.contacts <= touch.contacts and 0 < less.energy < touch.energy


def away(model: Model) -> np.ndarray:
    """Displacements (n, 3) [m], at random, of half a millimetre."""
    return 5e-4 * np.random.default_rng(0).normal(size=model.lattice.nodes.shape)


def test_gradient_is_that_of_the_energy_and_keeps_momentum(model, contacts):
    term, q = contacts.during(closed(model)), closed(model) + away(model)
    gradient = np.zeros_like(q)
    term.add_gradient(q, gradient)
    direction = np.random.default_rng(1).normal(size=q.shape)
    for step in (1e-7, 1e-12):  # a change that is small keeps its digits
        difference = term.change(q + step * direction, q - step * direction) / (2 * step)
        assert difference == pytest.approx(np.vdot(gradient, direction), rel=1e-3)
    size = np.abs(gradient).sum()
    assert size > 0 and np.abs(gradient.sum(axis=0)).max() < 1e-12 * size


def test_it_turns_nothing_where_the_step_begins(model, contacts):
    q = closed(model)
    gradient = np.zeros_like(q)
    contacts.during(q).add_gradient(q, gradient)
    assert np.abs(np.cross(q, gradient).sum(axis=0)).max() < 1e-10 * np.abs(np.cross(q, gradient)).sum()


def test_hessian_is_the_gradients_change_and_bounded(model, contacts):
    term, q = contacts.during(closed(model)), closed(model) + away(model)
    hessian, step = term.hessian(q, True), 1e-9
    assert hessian is not None
    v = np.random.default_rng(2).normal(size=q.shape)
    product, before, after = (np.zeros_like(q) for _ in range(3))
    hessian.add_product(v, product)
    term.add_gradient(q - step * v, before)
    term.add_gradient(q + step * v, after)
    np.testing.assert_allclose((after - before) / (2 * step), product, rtol=1e-5, atol=1e-5 * np.abs(product).max())
    largest = np.argmax(np.abs(hessian.blocks).max(axis=1))
    unit, product = np.zeros_like(q), np.zeros_like(q)
    unit[largest, 0] = 1.0
    hessian.add_product(unit, product)
    np.testing.assert_allclose(product[largest], hessian.blocks[largest, :3], rtol=1e-9)
    assert term.bound(q)[largest] >= np.linalg.eigvalsh(hessian.blocks[largest].reshape(3, 3))[-1]


def test_a_point_that_comes_in_within_the_step_is_pushed(model, contacts):
    """It begins in the part of a boundary cell that is outside the body."""
    apart, q = closed(model, -0.002), closed(model, 0.002)
    term = contacts.during(apart)
    assert contacts.touch(apart).contacts == 0 and not term.presses(apart)
    assert term.presses(q)
    assert -term.depths(q).max() == pytest.approx(contacts.touch(q).distance, abs=0.1 * CELL)


def test_arms_that_close_stop_at_each_other(tmp_path):
    """Without self-contact they pass through each other."""
    path = double_skin(tmp_path, time={"step": 0.01, "duration": 0.14})
    model, frames = play(path)
    text = path.read_text()
    path.write_text(text[: text.index("[self_contact]")])
    without = play(path)[1]
    top = (model.lattice.nodes[:, 0] > HALF / 2) & (model.lattice.nodes[:, 2] > 0.8 * ARM)
    assert without[-1].position[top, 0].mean() < -HALF
    assert frames[-1].position[top, 0].mean() == pytest.approx(RADIUS, rel=0.1)
    assert 0 < -np.nanmin([frame.self_distance for frame in frames]) < 0.1 * CELL
    assert sum(frame.energy_gained for frame in frames) < 1e-6  # [J]


def test_three_ranks_are_as_one(tmp_path, msmpetsc):
    """Also where the law asks for no cells of other ranks."""
    scene = double_skin(tmp_path, material=MATERIAL | {"law": "linear"}, solver={"preset": "newton", "error": 1e-8})
    for name, ranks in (("one.h5", 1), ("three.h5", 3)):
        done = msmpetsc(ranks, "run", scene, "-o", tmp_path / name, "--frames", 12)
        assert done.returncode == 0, done.stderr
    with msmpetsc_open(tmp_path / "one.h5") as one, msmpetsc_open(tmp_path / "three.h5") as three:
        assert one.frames.self_contacts[:].max() > 0
        apart = np.abs(three.frames.position[:] - one.frames.position[:]).max()
        assert apart < 1e-6 * np.abs(one.frames.position[:] - one.frames.position[0]).max()
        np.testing.assert_allclose(three.frames.self_distance[:], one.frames.self_distance[:], rtol=1e-4)


def test_a_resumed_run_is_the_same_to_the_last_bit(tmp_path, monkeypatch):
    monkeypatch.setattr(simulate, "REMEMBERED", 12)
    scene = load_scene(double_skin(tmp_path), ("time.duration=0.14",))
    model = build_model(COMM, scene)
    with Simulation(COMM, scene, model) as simulation:
        frames = [copy.deepcopy(simulation.saved()) if frame.index == 12 else frame for frame in simulation.frames()]
    with Simulation(COMM, scene, model) as simulation:
        simulation.restore(frames[12])
        resumed = list(simulation.frames())
    assert frames[13].self_contacts > 0 and len(resumed) == 2
    for one, other in zip(frames[13:], resumed, strict=True):
        np.testing.assert_array_equal(one.position, other.position)
