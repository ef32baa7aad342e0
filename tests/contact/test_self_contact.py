"""A surface that meets itself: derivatives, momentum, no crossing on one rank or three.

Also resumed runs, meshes that cut themselves, and refusals.
"""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import igl
import numpy as np
import pytest
import trimesh
from block_scene import GRAVITY, block_scene, model_of, play, solid_of, write_scene
from crossings import count_crossings, crossings
from pinch import ARM, HALF, RADIUS, pinch_scene, u_tube
from stopped_runs import assert_goes_on_exactly

from msmpetsc.build import Model
from msmpetsc.contact.surface.pairs import ContactSearch
from msmpetsc.contact.surface.surface_contact import SMALL, SurfaceContact
from msmpetsc.contact.surface.surface_friction import FrictionPairs, friction_pairs
from msmpetsc.errors import InputError
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.simulate import refuse_bad_options

# gap between the arms [m]; the barrier begins at 1e-3 m
GAP = 4e-4
T = 0.01


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Model:
    tables = {"self_contact": {"distance": 1e-3, "friction": 0.5}}
    return model_of(pinch_scene(tmp_path_factory.mktemp("pinch"), **tables))


def closed(model: Model) -> np.ndarray:
    """Return the nodes (n, 3) of the tube with its arms bent until their ends are GAP apart."""
    q = model.lattice.nodes.copy()
    end = np.clip(q[:, 2] / ARM, 0, None) ** 2
    q[:, 0] -= np.sign(q[:, 0]) * (HALF - RADIUS - GAP / 2) * end
    return q


def begun(contacts: ContactSearch, q: np.ndarray, *given: Any) -> SurfaceContact:
    """Return the contact of a step from q; ``given`` as in SurfaceContact, from ``last`` on."""
    return SurfaceContact(contacts, contacts.begin_step(q, 0.0, T), T, *given)


def contact(model: Model, slid: float = 0.0) -> tuple[SurfaceContact, np.ndarray]:
    """Return the contact of a step in which the left arm slides by a length [m], and its end."""
    q = closed(model)
    assert model.collision is not None
    end = q.copy()
    end[q[:, 0] < 0, 1] += slid
    return begun(ContactSearch(model.collision), q), end


def change(term: SurfaceContact, q: np.ndarray, base: np.ndarray) -> float:
    return term.at(q).change(term.at(base))


# without friction, below the kink of friction, and beyond it
@pytest.mark.parametrize("slid", [0.0, 1e-7, 1e-4])
def test_gradient_is_that_of_the_energy(model, slid: float):
    term, q = contact(model, slid)
    gradient = np.zeros_like(q)
    term.at(q).add_gradient(gradient)
    direction = np.random.default_rng(0).normal(size=q.shape)
    # moves beyond the limit below which forces give the change of energy
    for step in (
        1e-6,
        1e-7,
    ):
        difference = change(term, q + step * direction, q - step * direction) / (2 * step)
        assert difference == pytest.approx(np.vdot(gradient, direction), rel=1e-3)
    assert np.abs(gradient).max() > 0


@pytest.mark.parametrize("slid", [1e-7, 1e-4])
def test_a_small_change_of_the_energy_keeps_its_digits(model, slid: float):
    """A change of energy keeps its digits.

    Differences of energies had none: line searches of blocks at rest then shortened steps that led
    down.
    """
    term, q = contact(model, slid)
    forward = np.zeros_like(q)
    # the left arm approaches the right arm
    forward[q[:, 0] < 0, 0] = 1.0
    product, hessian, step = np.zeros_like(q), term.at(q).hessian(False), 1e-13
    assert hessian is not None
    hessian.add_product(forward, product)
    # the linear parts cancel
    bend = change(term, q + step * forward, q) + change(term, q - step * forward, q)
    assert bend / (step**2 * np.vdot(product, forward)) == pytest.approx(1, rel=1e-3)
    longest = np.abs(model.collision.points.moved(forward)).max()
    below, above = (
        change(term, q + share * SMALL * 1e-3 / longest * forward, q) / share
        for share in (0.999, 1.001)
    )
    # on both sides of the move at which the formula changes
    assert below / above == pytest.approx(1, rel=0.01)


@pytest.mark.parametrize("slid", [0.0, 1e-7])
def test_hessian_is_that_of_the_gradient_but_for_negative_parts(model, slid: float):
    term, q = contact(model, slid)
    hessian, step = term.at(q).hessian(False), 1e-8
    assert hessian is not None
    # the arms approach as a whole: no pair turns or slides, so nothing is left out
    direction = np.zeros_like(q)
    direction[q[:, 0] < 0, 0] = 1.0
    product, after, before = (np.zeros_like(q) for _ in range(3))
    hessian.add_product(direction, product)
    term.at(q + step * direction).add_gradient(after)
    term.at(q - step * direction).add_gradient(before)
    difference = (after - before) / (2 * step)
    assert np.linalg.norm(product - difference) < 0.02 * np.linalg.norm(difference)
    for seed in range(3):
        v, product = np.random.default_rng(seed).normal(size=q.shape), np.zeros_like(q)
        hessian.add_product(v, product)
        assert np.vdot(v, product) > 0


def test_friction_of_a_step_of_bdf2_goes_by_the_push_and_the_velocity_that_it_ends_with(model):
    q = closed(model)
    # the left arm moves towards the right arm and along it
    came = np.where(q[:, :1] < 0, [2e-5, 1e-4, 0.0], 0.0)
    contacts = ContactSearch(model.collision)
    now, before = (begun(contacts, at).friction for at in (q, q - came))
    friction = begun(contacts, q, q - came).friction
    expected = np.clip(2 * now.limit - now.values_of(before.pairs, before.limit), 0, 2 * now.limit)
    np.testing.assert_allclose(friction.limit, expected, atol=1e-6 * expected.max())
    assert 1.05 < friction.limit.sum() / now.limit.sum() < 2
    points = model.collision.points
    np.testing.assert_allclose(
        friction.slip(points(q + came, T))[0], 2 / 3 * now.along(points.moved(came)), atol=1e-15
    )
    assert friction.stick == pytest.approx(2 / 3 * now.stick)


def test_friction_goes_on_from_the_slip_that_pairs_held(model):
    q = closed(model)
    contacts = ContactSearch(model.collision)
    first = begun(contacts, q)
    stick, end = first.friction.stick, q.copy()
    end[q[:, 0] < 0, 1] += 0.4 * stick
    then = begun(contacts, end, None, None, first).friction
    held = first.friction.values_of(then.pairs, then.begin)
    np.testing.assert_allclose(
        held, first.friction.along(model.collision.points.moved(end - q)), atol=1e-12 * stick
    )
    assert np.linalg.norm(held, axis=1).max() > 0.2 * stick
    assert then.released(model.collision.points(end, T)) == pytest.approx(0, abs=1e-15)


def test_blocks_are_those_of_the_hessian_and_the_bound_is_no_less(model):
    term, q = contact(model)
    hessian = term.at(q).hessian(False)
    assert hessian is not None
    node = int(np.abs(hessian.blocks).max(axis=1).argmax())
    columns = np.empty((3, 3))
    for c in range(3):
        unit, product = np.zeros_like(q), np.zeros_like(q)
        unit[node, c] = 1.0
        hessian.add_product(unit, product)
        columns[:, c] = product[node]
    np.testing.assert_allclose(
        hessian.blocks[node].reshape(3, 3), columns, rtol=1e-10, atol=1e-12 * columns.max()
    )
    bound = term.at(q).bound()
    assert bound[node] >= np.linalg.eigvalsh(columns)[-1]
    assert set(np.log2(bound[bound > 0]) % 2) == {0.0}


def test_the_way_ends_before_surfaces_meet_however_far_it_goes(model):
    term, q = contact(model)
    through, opened, carried = q.copy(), q.copy(), q + np.array([5.0, 0, 0])
    through[q[:, 0] < 0, 0] += 2 * GAP
    opened[q[:, 0] < 0, 0] -= 2 * GAP
    # the arms meet halfway
    assert 0.3 < term.contacts.collision_free_step(q, through) < 0.5
    for end in (opened, carried):
        assert term.contacts.collision_free_step(q, end) == 1.0
    far = q.copy()
    # a path of many edge lengths whose end is free again
    far[q[:, 0] < 0, 0] += 500 * GAP
    assert 0 < term.contacts.collision_free_step(q, far) < 1 / 500


# otherwise the ends of the arms would turn inside out
SOLID = solid_of(1e5)


def test_arms_that_close_do_not_cross(tmp_path):
    path = pinch_scene(tmp_path, material=SOLID, time={"step": 0.01, "duration": 0.11})
    model, frames = play(path)
    assert crossings(model, frames) == 0
    assert 0 < np.nanmin([frame.self_distance for frame in frames]) < 1e-3
    text = path.read_text()
    path.write_text(text[: text.index("[self_contact]")])
    without = play(path)[1]
    assert crossings(model, without[-1:]) > 0 and np.isnan(without[-1].self_distance)


def test_a_run_that_goes_on_from_a_checkpoint_is_the_same_to_the_last_bit(tmp_path):
    friction = {"friction": 0.3, "distance": 1e-3}
    time = {"step": 0.01, "duration": 0.1}
    path = pinch_scene(tmp_path, material=SOLID, self_contact=friction, time=time)
    assert assert_goes_on_exactly(path, every=8)[9].self_contacts > 0


def test_triangles_that_cut_others_at_rest_are_left_out_and_named(tmp_path, caplog):
    """The first of two bars reaches into the second by 1 cm."""
    first = trimesh.creation.box([0.5, 0.25, 0.25])
    second = trimesh.creation.box([0.125, 0.125, 0.5])
    second.apply_translation([0.03, 0.02, 0.125 + 0.25 - 0.01])
    for _ in range(4):
        first, second = first.subdivide(), second.subdivide()
    path = block_scene(tmp_path, self_contact={}, time={"step": 0.01, "duration": 0.01})
    trimesh.util.concatenate([first, second]).export(tmp_path / "scene.ply")
    model = model_of(path)
    assert "triangles cut others at rest, the first at (" in caplog.text
    surface = model.collision.surface
    assert 0 < len(surface.triangles) < len(model.surface.triangles)
    assert count_crossings(surface.points, surface.triangles) == 0
    assert count_crossings(model.surface.points, model.surface.triangles) > 0


def test_a_triangle_that_names_a_point_twice_is_left_out(tmp_path):
    path = block_scene(tmp_path, self_contact={}, time={"step": 0.01, "duration": 0.01})
    block = trimesh.creation.box([0.5, 0.5, 0.25]).subdivide().subdivide().subdivide()
    rows = [*(block.faces + 1), (1, 1, 2), (3, 3, 3)]
    lines = [f"v {x} {y} {z}" for x, y, z in block.vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in rows]
    (tmp_path / "scene.obj").write_text("\n".join(lines))
    model = model_of(path, 'mesh.source="scene.obj"')
    assert len(model.surface.triangles) == len(rows)
    assert len(model.collision.surface.triangles) == len(block.faces)


def test_a_surface_that_cuts_itself_all_over_is_refused(tmp_path):
    path = pinch_scene(tmp_path)
    trimesh.util.concatenate([u_tube(), u_tube(around=15, along=57)]).export(tmp_path / "u.ply")
    with pytest.raises(InputError, match=r"self_contact: .* cut others at rest.*union.*repair"):
        model_of(path)


def test_a_coarser_surface_that_cuts_itself_is_no_fault_of_the_mesh(tmp_path):
    """A coarser surface cuts itself because flat faces leave slivers on its edges."""
    path = block_scene(
        tmp_path, self_contact={"surface": 300}, time={"step": 0.01, "duration": 0.01}
    )
    block = trimesh.creation.box([0.5, 0.5, 0.25]).subdivide().subdivide().subdivide()
    block.export(tmp_path / "scene.ply")
    with pytest.raises(InputError, match=r"leave out self_contact\.surface"):
        model_of(path)
    assert model_of(path, "self_contact={}").collision is not None


def test_a_coarser_surface_lies_on_the_body_says_how_far_it_is_off_and_pushes_from_there(
    tmp_path, caplog
):
    model = model_of(pinch_scene(tmp_path, self_contact={"surface": 400}))
    surface, whole = model.collision.surface, model.surface.points
    assert 300 < len(surface.triangles) <= 400
    squares = igl.point_mesh_squared_distance(surface.points, whole, model.surface.triangles)[0]
    assert squares.max() < 1e-18
    np.testing.assert_allclose(
        model.collision.points(model.lattice.nodes, 0.0), surface.points, atol=1e-12
    )
    off = np.sqrt(igl.point_mesh_squared_distance(whole, surface.points, surface.triangles)[0])
    words = f"{off.max():.2g} m off the drawn surface, half of it by more than {np.median(off):.2g}"
    assert words in caplog.text
    diagonal = np.linalg.norm(np.ptp(whole, axis=0))
    cell = model.lattice.cell_size
    assert model.collision.law.distance == pytest.approx(max(np.median(off), cell / 24))
    assert np.median(off) > 3e-4 * diagonal
    caplog.clear()
    far = {"surface": 400, "distance": 1.01 * off.max()}
    model = model_of(pinch_scene(tmp_path, self_contact=far))
    assert model.collision.law.distance > off.max()
    assert "the drawn surface" not in caplog.text


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ('time.integrator="verlet"', "is for time.integrator"),
        ('time.integrator="static"', "is for time.integrator"),
        (
            'obstacle=[{shape="plane", point=[0,0,-1], normal=[0,0,1], response="exchange"}]',
            "surface contact",
        ),
        ("self_contact.distance=0", "self_contact.distance"),
        ("self_contact.friction=-1", "self_contact.friction"),
    ],
)
def test_what_would_move_the_surface_past_itself_is_refused(tmp_path, override: str, message: str):
    path = pinch_scene(tmp_path)
    with pytest.raises(InputError, match=message):
        load_scene(path, (override,))


def test_presets_of_a_are_refused(tmp_path):
    scene = load_scene(pinch_scene(tmp_path), ("solver.preset=anderson",))
    with pytest.raises(InputError, match="one of newton's presets, not anderson"):
        refuse_bad_options(scene)


def test_a_pair_of_edges_is_the_same_whichever_is_found_first():
    """A pair of edges has one number and one sign of slip, so its slip persists."""

    def found(first: int, second: int, at: tuple[float, float]) -> FrictionPairs:
        pair = SimpleNamespace(
            edge0_id=first,
            edge1_id=second,
            closest_point=np.array(at),
            weight=1.0,
            normal_force_magnitude=2.0,
        )
        built = SimpleNamespace(
            vv_collisions=[], ev_collisions=[], ee_collisions=[pair], fv_collisions=[]
        )
        return friction_pairs([built], mesh)

    edges, faces = np.array([[1, 5], [2, 4]]), np.empty((0, 3), int)
    mesh = SimpleNamespace(edges=edges, faces=faces, num_vertices=6)
    one, other = found(0, 1, (0.7, 0.6)), found(1, 0, (0.6, 0.7))
    assert one.numbers.tolist() == other.numbers.tolist() == [[1, 5, 2, 4]] and one.push == [2.0]
    np.testing.assert_allclose(one.weights, [[0.3, 0.7, -0.4, -0.6]])
    points, moved = np.random.default_rng(1).normal(size=(2, 6, 3))
    along, same = (pairs.slips(points) @ moved.ravel() for pairs in (one, other))
    assert along.any() and np.array_equal(along, same)
    # motion within the plane of contact
    assert along @ (one.weights @ points[one.numbers[0]])[0] == pytest.approx(0)


@pytest.mark.slow
def test_blocks_of_long_triangles_touch_at_their_corners_and_say_so(tmp_path: Path, caplog):
    """Between the corners of long triangles a face bulges, so the upper block sinks further.

    If triangles are as fine as the cells, the faces touch everywhere.
    """
    sunk = []
    trimesh.creation.box(bounds=[[-0.5, -0.5, 0], [0.5, 0.5, 1]]).export(tmp_path / "cube.ply")
    below = {"region": {"box": [[-1, -1, -1], [1, 1, 1e-3]]}}
    for steps in ([], [{"refine": 0.125}], [{"refine": 0.0625}]):
        tables = {
            "body": [
                {"mesh": {"source": "cube.ply", "prepare": steps}, "pin": [below]},
                {"mesh": {"source": "cube.ply", "prepare": steps, "base": [0, 0, 1.002]}},
            ],
            "cages": {"cell_size": 0.125},
            "material": solid_of(1e5, damping=20.0),
            "time": {"step": 0.05, "duration": 0.5},
            "gravity": GRAVITY,
            "self_contact": {"distance": 1e-3},
        }
        model, frames = play(write_scene(tmp_path, **tables))
        top = model.lattice.nodes[:, 2] > 2.0
        sunk.append((model.lattice.nodes - frames[-1].position)[top, 2].mean())
    assert sunk[1] == pytest.approx(sunk[2], rel=0.01) and 0.1 < sunk[1] < 0.8 * sunk[0]
    assert sum("longer than a twentieth" in record.message for record in caplog.records) == 1
