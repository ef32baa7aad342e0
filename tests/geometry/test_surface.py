"""Measures and checks of surfaces."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from msmpetsc.errors import InputError
from msmpetsc.geometry.surface import Surface, check_encloses, examine, first_of_equal

SIDES = (1.0, 2.0, 3.0)


def box(sides=SIDES) -> Surface:
    mesh = trimesh.creation.box(sides)
    return Surface(np.array(mesh.vertices), np.array(mesh.faces, np.int64))


def test_edges_of_an_open_flipped_and_finned_box():
    surface = box()
    clean = examine(surface)
    assert clean.closed and clean.volume == pytest.approx(6) and clean.area == pytest.approx(22)
    assert (clean.boundary_edges, clean.nonmanifold_edges, clean.inconsistent_edges) == (0, 0, 0)

    holed = examine(Surface(surface.points, surface.triangles[1:]))
    assert holed.boundary_edges == 3 and not holed.closed

    triangles = surface.triangles.copy()
    triangles[0] = triangles[0, ::-1]
    assert examine(Surface(surface.points, triangles)).inconsistent_edges == 3

    points = np.vstack([surface.points, [[9, 9, 9], [8, 8, 8]]])
    a, b, _ = surface.triangles[0]
    fin = examine(Surface(points, np.vstack([surface.triangles, [[a, b, 8]]])))
    assert (fin.nonmanifold_edges, fin.boundary_edges) == (1, 2)


def test_loose_triangles_count_as_closed():
    surface = box()
    loose = Surface(surface.points[surface.triangles].reshape(-1, 3), np.arange(36).reshape(-1, 3))
    assert examine(loose).closed
    # a triangle with two corners at the same place bounds nothing
    degenerate = Surface(loose.points, np.vstack([loose.triangles, [[0, 1, 0]]]))
    assert examine(degenerate).closed


@given(
    shift=arrays(float, 3, elements=st.floats(-100, 100)),
    seed=st.integers(0, 1000),
    sides=st.tuples(*[st.floats(0.01, 10)] * 3),
)
def test_volume_does_not_depend_on_place_or_numbering(shift, seed, sides):
    rng = np.random.default_rng(seed)
    surface = box(sides)
    order = rng.permutation(8)
    moved = Surface(
        (surface.points + shift)[order], np.argsort(order)[surface.triangles][rng.permutation(12)]
    )
    assert examine(moved).volume == pytest.approx(np.prod(sides), rel=1e-6)
    inwards = Surface(moved.points, moved.triangles[:, ::-1])
    assert examine(inwards).volume == pytest.approx(-np.prod(sides), rel=1e-6)


@given(arrays(np.int64, (12, 3), elements=st.integers(-1, 1)))
def test_equal_points_share_the_number_of_the_first(points):
    points = points.astype(float)
    # this may give -0.0, which equals 0.0
    points[0] *= -1.0
    expected = [next(j for j in range(12) if (points[j] == points[i]).all()) for i in range(12)]
    assert first_of_equal(points).tolist() == expected


def rotated(surface: Surface) -> Surface:
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3]
    return Surface(surface.points @ turn.T, surface.triangles)


def test_a_thin_plate_and_a_thin_rod_enclose_a_volume():
    for sides in ((1, 1, 1e-3), (1, 1e-3, 1e-3), (1e3, 1e3, 1), (1e-6, 1e-6, 1e-9)):
        surface = rotated(box(sides))
        assert check_encloses(surface, examine(surface)) == []


def test_what_encloses_nothing_is_refused():
    sheet = Surface(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    solid = box()
    against = Surface(
        np.vstack([solid.points, solid.points + 5.0]),
        np.vstack([solid.triangles, solid.triangles[:, ::-1] + 8]),
    )
    for surface in (sheet, rotated(sheet), box((1, 1, 0)), rotated(box((1, 1, 0))), against):
        with pytest.raises(InputError, match="encloses no volume"):
            check_encloses(surface, examine(surface))
    # a sheet folded over its own back and bent: closed, not flat, no volume
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    fold = Surface(corner, np.array([[0, 1, 2], [0, 2, 1], [0, 2, 3], [0, 3, 2]]))
    with pytest.raises(InputError, match="folded"):
        check_encloses(fold, examine(fold))
