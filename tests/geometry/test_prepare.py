"""The prepare steps, scaling and placing."""

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from surfaces import surface_of

from msmpetsc.errors import InputError
from msmpetsc.geometry.prepare import prepare
from msmpetsc.geometry.readers import read_surface
from msmpetsc.geometry.surface import Surface, examine, joined


def box(middle=(0, 0, 0), side=1.0) -> Surface:
    surface = surface_of(trimesh.creation.box((side, side, side)))
    return Surface(surface.points + middle, surface.triangles)


def inside_out(surface: Surface) -> Surface:
    return Surface(surface.points, surface.triangles[:, ::-1])


def real(name: str) -> Surface:
    folder = os.environ.get("MSMPETSC_MESH_DIR")
    if not folder:
        pytest.skip("MSMPETSC_MESH_DIR is not set")
    return read_surface(Path(folder) / name)


def test_merge_joins_loose_triangles_and_drops_what_is_of_no_use():
    surface = box()
    points = np.vstack([surface.points[surface.triangles].reshape(-1, 3), [[7, 7, 7]]])
    triangles = np.vstack([np.arange(36).reshape(-1, 3), [[0, 1, 0]]])
    merged = prepare(Surface(points, triangles), ["merge"])
    assert merged.points.shape == (8, 3) and merged.triangles.shape == (12, 3)
    assert examine(merged).volume == pytest.approx(1)
    # the first points keep their order
    assert np.array_equal(merged.points[0], points[0])


def test_largest_part_is_the_one_of_most_area_not_of_most_triangles():
    ball = surface_of(trimesh.creation.icosphere(3, radius=0.1))
    kept = prepare(joined((ball, box((5, 0, 0)))), ["largest_part"])
    assert kept.triangles.shape == (12, 3) and kept.points.shape == (8, 3)
    assert kept.points.mean(axis=0) == pytest.approx([5, 0, 0])


def test_union_of_overlapping_boxes_counts_the_overlap_once():
    parts = joined((box(), inside_out(box((0.5, 0, 0))), box((9, 0, 0))))
    solid = prepare(parts, ["union"])
    report = examine(solid)
    # 1 + 1 - 1/2 + 1
    assert report.closed and report.volume == pytest.approx(2.5)


def test_union_refuses_an_open_part():
    opened = Surface(box().points, box().triangles[1:])
    with pytest.raises(InputError, match=r"'union'.*part 1 .*3 boundary edges"):
        prepare(joined((box((5, 0, 0)), opened)), ["union"])


def test_repair_closes_a_hole_and_keeps_every_part():
    pytest.importorskip("pymeshfix")
    opened = Surface(box().points, box().triangles[1:])
    report = examine(prepare(joined((opened, box((5, 0, 0)))), ["repair"]))
    assert report.closed and report.volume == pytest.approx(2)


def test_repair_that_loses_the_body_is_refused():
    pytest.importorskip("pymeshfix")
    with pytest.raises(InputError, match=r"'repair'.*area was left"):
        prepare(real("lung_parts.ply"), ["repair"])


def pipe(hole: float) -> Surface:
    """Return a pipe with walls of 5 cm, whose inner wall ends at x = ``hole`` [m]."""
    surface = surface_of(
        trimesh.creation.annulus(0.45, 0.5, 1.0, sections=64).subdivide().subdivide()
    )
    middles = surface.points[surface.triangles].mean(axis=1)
    lacks = (np.linalg.norm(middles[:, :2], axis=1) < 0.46) & (middles[:, 0] > hole)
    return Surface(surface.points, surface.triangles[~lacks])


def test_repair_tells_how_much_of_the_surface_it_changed(caplog):
    pytest.importorskip("pymeshfix")
    ball = surface_of(trimesh.creation.icosphere(subdivisions=5))
    inner = trimesh.creation.icosphere(3, radius=0.9).apply_translation([0.15, 0, 0])
    inner.invert()
    crossing = joined((surface_of(trimesh.creation.icosphere(3)), surface_of(inner)))
    small_hole = Surface(ball.points, ball.triangles[9:])
    for surface, change in ((pipe(9.0), 0), (small_hole, 0), (pipe(0.35), 11), (crossing, -46)):
        caplog.clear()
        prepare(surface, ["repair"])
        said = [f"changed the surface's area by {change:+d}%"] if change else []
        assert [line for line in said if line in caplog.text] == said and len(
            caplog.messages
        ) == len(said)


def test_simplify_reduces_and_stays_closed():
    ball = surface_of(trimesh.creation.icosphere(4))
    reduced = prepare(ball, [{"simplify": 1000}])
    report = examine(reduced)
    assert 900 <= len(reduced.triangles) <= 1000
    assert report.closed and report.volume == pytest.approx(4 / 3 * np.pi, rel=0.02)
    assert len(prepare(ball, [{"simplify": 10**6}]).triangles) == len(ball.triangles)


def test_simplify_mends_what_it_pinches():
    """The dragon's surface, reduced to 10,000 triangles, would have pinched edges."""
    pytest.importorskip("pymeshfix")
    dragon = real("dragon.ply")
    reduced = prepare(dragon, [{"simplify": 10000}])
    report = examine(reduced)
    assert report.closed and report.nonmanifold_edges == 0
    assert report.volume == pytest.approx(examine(dragon).volume, rel=0.01)


@given(st.sets(st.integers(0, 79)))
def test_orient_undoes_any_flips(flips):
    ball = surface_of(trimesh.creation.icosphere(1))
    triangles = ball.triangles.copy()
    triangles[list(flips)] = triangles[list(flips)][:, ::-1]
    report = examine(prepare(Surface(ball.points, triangles), ["orient"]))
    assert report.inconsistent_edges == 0
    assert report.volume == pytest.approx(examine(ball).volume)


def test_orient_turns_each_part_outwards_also_loose_and_open_ones():
    parts = joined((box(), inside_out(box((5, 0, 0)))))
    loose = Surface(parts.points[parts.triangles].reshape(-1, 3), np.arange(72).reshape(-1, 3))
    assert examine(prepare(parts, ["orient"])).volume == pytest.approx(2)
    assert examine(prepare(loose, ["orient"])).volume == pytest.approx(2)
    opened = inside_out(Surface(box().points, box().triangles[1:]))
    turned = prepare(opened, ["orient"])
    assert np.array_equal(np.sort(turned.triangles), np.sort(opened.triangles))
    assert examine(turned).volume > 0 > examine(opened).volume


@given(st.lists(st.booleans(), min_size=7, max_size=7), st.floats(0, 1e7))
def test_orient_winds_cavities_inwards_and_their_cores_outwards(inwards, shift):
    """The mesh is a ball in a ball in a ball, and boxes.

    A box contains a box, a second box lies over its edge, and a third box is far away.
    """
    balls = [surface_of(trimesh.creation.icosphere(1, radius=radius)) for radius in (1.0, 0.7, 0.4)]
    parts = [*balls, box((5, 0, 0), 2.0), box((5.2, 0, 0)), box((6, 0, 0)), box((9, 0, 0))]
    outwards = np.array([examine(part).volume for part in parts]) * [1, -1, 1, 1, -1, 1, 1]
    turned = [inside_out(part) if turn else part for part, turn in zip(parts, inwards, strict=True)]
    mesh = joined(turned)
    mended = prepare(Surface(mesh.points + shift, mesh.triangles), ["orient"])
    ends = np.cumsum([len(part.triangles) for part in parts])[:-1]
    volumes = [
        examine(Surface(mended.points, triangles)).volume
        for triangles in np.split(mended.triangles, ends)
    ]
    assert volumes == pytest.approx(outwards, rel=1e-6)


def test_orient_refuses_a_one_sided_surface():
    """The mesh is a Möbius band of five triangles, each sharing two points with the next."""
    band = np.array([[i, (i + 1) % 5, (i + 2) % 5] for i in range(5)])
    points = np.random.default_rng(1).random((5, 3))
    with pytest.raises(InputError, match=r"'orient'.*one side only"):
        prepare(Surface(points, band), ["orient"])


@given(
    size=st.floats(1e-3, 1e3),
    base=st.tuples(*[st.floats(-10, 10)] * 3),
    sides=st.tuples(*[st.floats(0.1, 10)] * 3),
)
def test_size_and_base_place_the_bounding_box(size, base, sides):
    points = box().points * sides + 3.0
    # a point that no triangle uses
    stray = np.vstack([points, [[1e6, 1e6, -1e6]]])
    placed = prepare(Surface(stray, box().triangles), [], size=size, base=base).points[:8]
    low, high = placed.min(axis=0), placed.max(axis=0)
    assert (high - low).max() == pytest.approx(size, rel=1e-9)
    middle = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]]
    assert middle == pytest.approx(base, abs=1e-9 * max(size, 10))


@pytest.mark.parametrize("step", ["union", "repair", {"simplify": 200}, {"refine": 0.2}])
def test_steps_are_as_exact_far_from_the_origin(step):
    if step == "repair":
        pytest.importorskip("pymeshfix")
    ball = surface_of(trimesh.creation.icosphere(3, radius=0.15))
    ball = Surface(ball.points, ball.triangles[3 * (step == "repair") :])
    far = np.array([441871.6, 6329700.7, 120.3])
    near, moved = (
        examine(prepare(Surface(ball.points + shift, ball.triangles), [step])) for shift in (0, far)
    )
    assert moved.volume == pytest.approx(near.volume, rel=1e-6) and moved.area == pytest.approx(
        near.area, rel=1e-6
    )


def test_steps_run_in_the_order_given_and_leave_the_input_alone():
    surface = box((1, 0, 0))
    points = surface.points.copy()
    quarter = {"rotate": {"axis": [0, 0, 1], "degrees": 90}}
    half = {"rotate": {"axis": [1, 0, 0], "degrees": 180}}
    one = prepare(surface, [quarter, half]).points.mean(axis=0)
    other = prepare(surface, [half, quarter]).points.mean(axis=0)
    assert one == pytest.approx([0, -1, 0], abs=1e-12)
    assert other == pytest.approx([0, 1, 0], abs=1e-12)
    assert np.array_equal(surface.points, points)


def test_a_step_that_leaves_nothing_is_an_error():
    point = Surface(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    for step in ("merge", "union", "repair", {"simplify": 10}):
        name = step if isinstance(step, str) else "simplify"
        with pytest.raises(InputError, match=f"'{name}': all triangles are degenerate"):
            prepare(point, [step])
    with pytest.raises(InputError, match="size"):
        prepare(point, [], size=1.0)
    with pytest.raises(InputError, match="'rotate' failed"):
        prepare(box(), [{"rotate": {"degrees": 9}}])
