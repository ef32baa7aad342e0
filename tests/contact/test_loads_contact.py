"""Regions, forces shared out over them, and nodes that bounce off a plane."""

import numpy as np
import pytest
import trimesh
from conftest import WORKERS
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mpi4py import MPI

from msmpetsc.constraints.loads import Load, Motion, spread_by_mass
from msmpetsc.contact.obstacles.obstacle import Obstacle
from msmpetsc.contact.obstacles.reflection import Exchange, StepTaken
from msmpetsc.contact.obstacles.solids import Faces
from msmpetsc.geometry.cages import Body, fill
from msmpetsc.geometry.inside import inside
from msmpetsc.geometry.surface import Surface, examine
from msmpetsc.lattice.lattice import build_lattice
from msmpetsc.scene.body import Region

WORKER = WORKERS / "cages_worker.py"
BOUNDS = np.array([[-1.0, 0.0, 2.0], [3.0, 2.0, 3.0]])  # sides 4, 2, 1


def holds(region: dict, *points: list[float]) -> list[bool]:
    return inside(Region.model_validate(region), np.array(points, float), BOUNDS).tolist()


def test_box_absolute_and_relative():
    box = {"box": [[0, 0, 0], [1, 1, 0.5]]}
    assert holds(box, [0, 0, 0], [1, 1, 0.5], [0.5, 0.5, 0.51], [-0.01, 0.5, 0.2]) == [True, True, False, False]
    # relative: x from -1 to 3, y from 0 to 2, z from 2 to 2.5
    points = [[-1, 0, 2], [3, 2, 2.5], [3.01, 1, 2.2], [0, 1, 2.51], [0.5, 0.5, 0.2]]
    # at the body's own bounds in x, in y and below it is open outwards: cells stick out there
    assert holds(box | {"relative": True}, *points) == [True, True, True, False, True]


def test_sphere_absolute_and_relative():
    ball = {"sphere": {"center": [0.5, 0.5, 0.5], "radius": 0.25}}
    assert holds(ball, [0.5, 0.5, 0.75], [0.5, 0.25, 0.5], [0.7, 0.7, 0.5]) == [True, True, False]
    # relative: centre at (1, 1, 2.5), the radius a quarter of the longest side, so 1; it stays round
    points = [[2, 1, 2.5], [1, 2, 2.5], [1, 1, 1.5], [2.01, 1, 2.5], [1, 1, 3.51]]
    assert holds(ball | {"relative": True}, *points) == [True, True, True, False, False]


def test_half_space_absolute_and_relative():
    half = {"half_space": {"point": [0, 0, 0.5], "normal": [0, 3, 4]}}
    assert holds(half, [9, 0, 0.5], [0, 4, -2.5], [0, 4, -2.51], [0, -0.1, 0.5]) == [True, True, False, False]
    # relative: the point is (-1, 0, 2.5), the normal is not scaled
    assert holds(half | {"relative": True}, [0, 4, -0.5], [0, 4, -0.51]) == [True, False]


def aligned_beam():
    """1 x 0.5 x 0.3 m of cells of 0.1 m; 3 * 0.1 is a little more than 0.3, which a region must not see."""
    box = trimesh.creation.box((1, 0.5, 0.3))
    points = np.array([1, 0.5, 0.3]) * (box.vertices > 0)
    surface = Surface(points, np.asarray(box.faces, np.int64))
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    return build_lattice(fill([Body(MPI.COMM_SELF, surface, examine(surface), bounds)], 0.1), 1000.0, 1e5), bounds


def within_three() -> int:
    """Grid points i, j, k >= 0 within a distance of 3: in integers nothing is rounded."""
    i, j, k = np.indices((4, 4, 4))
    return int((i**2 + j**2 + k**2 <= 9).sum())


def test_a_region_that_ends_where_the_lattice_does_holds_its_last_nodes():
    lattice, bounds = aligned_beam()
    ends = {
        "top": (Region(box=((0, 0, 0.9), (1, 1, 1)), relative=True), 11 * 6),
        "top, absolute": (Region(box=((0, 0, 0.29), (1, 0.5, 0.3))), 11 * 6),
        "half space": (Region.model_validate({"half_space": {"point": [0, 0, 0.3], "normal": [0, 0, 1]}}), 11 * 6),
        "end": (Region(box=((0.99, 0, 0), (1, 1, 1)), relative=True), 6 * 4),
        "ball": (Region.model_validate({"sphere": {"center": [0, 0, 0], "radius": 0.3}}), within_three()),
    }
    for name, (region, count) in ends.items():
        assert inside(region, lattice.nodes, bounds).sum() == count, name


def test_force_is_shared_out_by_mass():
    mass = np.array([1.0, 2.0, 5.0, 4.0])
    where = np.array([True, True, False, True])
    force = spread_by_mass(MPI.COMM_SELF, (7.0, 0.0, -14.0), where, mass)
    assert force == pytest.approx(np.array([[1, 0, -2], [2, 0, -4], [0, 0, 0], [4, 0, -8]]))


@pytest.mark.parametrize("ranks", [1, 2])
def test_shared_out_over_ranks_it_sums_to_the_total(on_ranks, ranks):
    done = on_ranks(ranks, "-m", "mpi4py", WORKER, "force", timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("passed") == ranks


def test_load_acts_from_start_to_before_stop():
    load = Load(np.zeros((1, 3)), 1.0, 2.0)
    assert [load.acts_at(time) for time in (0.99, 1.0, 1.99, 2.0)] == [False, True, True, False]


def test_a_time_that_is_rounded_beside_start_or_stop_counts_as_it():
    late = np.nextafter(1.8, 0)
    assert not Load(np.zeros((1, 3)), 0.0, 1.8).acts_at(late) and Load(np.zeros((1, 3)), 1.8, 2.0).acts_at(late)


FLOOR = np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
STILL = Motion.through(())


def exchanged(q, q_previous, point, normal, e):
    """At a plane at rest."""
    return Exchange(Obstacle(Faces(point[None], normal[None]), STILL), e).exchanged(q, q_previous, StepTaken(1.0, 0.1))


def test_an_exchange_reverses_only_what_goes_into_the_plane():
    q_previous = np.array([[0, 0, 0.5], [0, 0, -2], [0, 0, 2.0], [1, 1, 0.2]])
    q = np.array([[1, 2, -0.5], [1, 2, -1], [1, 2, 1.0], [1, 1, 0.0]])
    # the first goes in; the second is behind but leaves; the third is still above; the fourth just arrives
    after, before = exchanged(q, q_previous, *FLOOR, 1.0)
    assert np.array_equal(after, [[1, 2, 0.5], [1, 2, -1], [1, 2, 1], [1, 1, 0.2]])
    assert np.array_equal(before, [[0, 0, -0.5], [0, 0, -2], [0, 0, 2], [1, 1, 0]])


coordinates = arrays(float, (6, 3), elements=st.integers(-64, 64).map(lambda x: x / 16))


@given(coordinates, coordinates, st.sampled_from([0.0, 0.25, 1.0]), st.sampled_from([0, 1, 2]), st.integers(-2, 2))
def test_normal_velocity_becomes_minus_e_times_itself(q, q_previous, e, axis, height):
    normal = np.eye(3)[axis] * (-1 if height < 0 else 1)
    after, before = exchanged(q, q_previous, height * normal, normal, e)
    v, v_after = q - q_previous, after - before
    hit = ((q @ normal) <= height) & (v @ normal < 0)
    assert np.array_equal(v_after @ normal, np.where(hit, -e * (v @ normal), v @ normal))
    along = np.eye(3)[np.arange(3) != axis]
    assert np.array_equal(after @ along.T, q @ along.T) and np.array_equal(before @ along.T, q_previous @ along.T)
    assert np.array_equal(after[~hit], q[~hit]) and np.array_equal(before[~hit], q_previous[~hit])
    assert np.array_equal(after[hit] @ normal, q_previous[hit] @ normal)  # back where it came from


def test_an_oblique_plane_keeps_the_sliding_part():
    normal = np.array([0.0, 0.6, 0.8])
    q, q_previous = np.array([[1.0, -0.5, -0.1]]), np.array([[0.0, 0.4, 0.3]])
    after, before = exchanged(q, q_previous, np.zeros(3), normal, 1.0)
    v = (q - q_previous)[0]
    assert (after - before)[0] == pytest.approx(v - 2 * (v @ normal) * normal)


def bounce(e: float, steps: int, t: float = 1 / 64) -> np.ndarray:
    """Heights of a free particle dropped from 1 m, q_(n+1) = 2 q_n - q_(n-1) + t^2 g; all sums here are exact."""
    gravity = np.array([0, 0, -8.0])
    q = q_previous = np.array([[0, 0, 1.0]])
    heights = []
    for _ in range(steps):
        q, q_previous = 2 * q - q_previous + t**2 * gravity, q
        q, q_previous = exchanged(q, q_previous, *FLOOR, e)
        heights.append(q[0, 2])
    return np.array(heights)


def test_a_dropped_particle_bounces_to_its_height():
    # q_n = 1 - 8 t^2 n (n + 1) / 2 reaches 0 at n (n + 1) / 2 >= 512, n = 32; the exchange then runs the fall
    # backwards step for step: the recurrence is symmetric in time
    heights = bounce(1.0, 4 * 32)
    down = 1 - 8 / 64**2 * np.arange(1, 32) * np.arange(2, 33) / 2
    assert np.array_equal(heights[:31], down)
    assert np.array_equal(heights[31:62], down[::-1]) and heights[62] == heights[63] == 1.0
    assert heights.max() == 1.0


def test_less_restitution_means_less_height():
    top = [bounce(e, 200)[31:].max() for e in (0.0, 0.5, 0.75, 1.0)]
    # height goes with the square of speed, to the order of the time step
    assert top[0] <= 0.07 and top[1] == pytest.approx(0.25, abs=0.07) and top[2] == pytest.approx(0.5625, abs=0.07)
    assert top[3] == 1.0
