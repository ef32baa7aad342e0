"""Fills of cells and corners: volumes, first moments, planes, open and wrongly wound surfaces."""

import logging

import numpy as np
import pytest
import trimesh
from surfaces import body_of

from msmpetsc.geometry.cages import BOUNDARY, LEAST_FILL, Cages, fill
from msmpetsc.geometry.fill_fractions import Columns
from msmpetsc.geometry.grid import packed
from msmpetsc.geometry.valid_cells import touched_cells

TURN = trimesh.transformations.rotation_matrix(1.1, [3, 2, 1])
BODIES = {
    "ball": trimesh.creation.icosphere(3),
    "tilted box": trimesh.creation.box((1.0, 0.7, 0.4)).apply_transform(TURN),
    "torus": trimesh.creation.torus(1.0, 0.3).apply_transform(TURN),
    "pipe": trimesh.creation.annulus(0.4, 0.5, 1.5).apply_transform(TURN),
    "hollow": trimesh.util.concatenate(
        [trimesh.creation.icosphere(2), trimesh.creation.icosphere(2, 0.5)]
    ),
}
BODIES["hollow"].faces[320:] = BODIES["hollow"].faces[320:, ::-1]


def columns_of(
    mesh: trimesh.Trimesh, h: float, offset: float = 0.0
) -> tuple[Columns, np.ndarray, np.ndarray]:
    """Return the columns of a mesh in cells of h, all cells of its box, and their first cell.

    The grid begins ``offset`` cells before the mesh.
    """
    origin = mesh.bounds[0] - offset * h
    corners = (mesh.vertices - origin)[mesh.faces] / h
    shape = np.ceil(corners.max(axis=(0, 1))).astype(np.int64) + 1
    cells = np.indices(shape).reshape(3, -1).T
    keys = packed(cells)
    touched, number = touched_cells(corners, np.zeros(3, np.int64), shape)
    return Columns.crossed(corners, number, np.searchsorted(keys, touched), keys), cells, origin


@pytest.mark.parametrize("offset", [0.0, 0.3])
@pytest.mark.parametrize("name", BODIES)
def test_fills_have_the_bodys_volume_and_its_centre(name: str, offset: float):
    """Both are exact: corner functions sum to 1, and times their corners to the position."""
    mesh, h = BODIES[name], 0.17
    columns, cells, origin = columns_of(mesh, h, offset)
    fills = columns.corners
    assert fills.min() > -1e-12 and fills.max() < 1 + 1e-12 and columns.leak < 1e-12
    assert fills.mean(axis=(1, 2, 3)).sum() * h**3 == pytest.approx(mesh.volume, rel=1e-13)
    corners = cells[:, None] + np.indices((2, 2, 2)).reshape(3, 8).T
    centre = np.einsum("cv,cvx->x", fills.reshape(-1, 8), corners) * h**4 / 8 / mesh.volume + origin
    np.testing.assert_allclose(centre, mesh.center_mass, atol=1e-13)


def test_a_plane_through_a_cell_gives_its_corners_what_lies_near_them():
    """Below z the lower corners have 2 z - z^2 and the upper corners z^2.

    These are the integrals of 2 (1 - z) and 2 z.
    """
    box = trimesh.creation.box(bounds=[[0, 0, 0], [3, 2, 1.3]])
    columns, cells, _ = columns_of(box, 1.0)
    fills = [columns.corners[(cells == cell).all(axis=1)][0] for cell in ([1, 1, 1], [1, 1, 0])]
    np.testing.assert_allclose(
        fills[0], np.broadcast_to([2 * 0.3 - 0.3**2, 0.3**2], (2, 2, 2)), atol=1e-14
    )
    np.testing.assert_allclose(fills[1], 1, atol=1e-14)


def test_corners_of_an_oblique_cell_are_those_of_many_samples():
    mesh, h = BODIES["tilted box"], 0.2
    columns, cells, origin = columns_of(mesh, h)
    fills = columns.corners
    cut = np.flatnonzero(np.ptp(fills.reshape(-1, 8), axis=1) > 0.3)[:5]
    assert len(cut) == 5
    points = np.random.default_rng(0).random((40_000, 3))
    functions = np.prod(
        np.where(
            np.indices((2, 2, 2)).reshape(3, 8, 1) == 1, points.T[:, None], 1 - points.T[:, None]
        ),
        0,
    )
    to_box = np.linalg.inv(TURN[:3, :3])
    for cell in cut:
        inside = (np.abs((origin + h * (cells[cell] + points)) @ to_box.T) <= [0.5, 0.35, 0.2]).all(
            axis=1
        )
        found = 8 * functions[:, inside].sum(axis=1) / len(points)
        # four standard deviations of a sample
        np.testing.assert_allclose(fills[cell].ravel(), found, atol=0.02)


# ---- cages


def volume(cages: Cages) -> float:
    return cages.fills.mean(axis=(1, 2, 3)).sum() * cages.grids.cell_size**3


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_longest_side_may_be_any_and_faces_may_be_wound_inwards(axis: int):
    """The result does not depend on the cyclic order of axes or on the winding."""
    mesh = trimesh.creation.box(bounds=[[0, 0, 0], np.roll([1.0, 0.53, 0.38], axis)])
    expected = fill([body_of(mesh)], 0.1)
    top = expected.ijk[:, (axis + 2) % 3] == 3
    # corners outside the body have a least fill, which adds to the volume
    assert volume(expected) == pytest.approx(mesh.volume, rel=1e-3)
    along = np.moveaxis(expected.fills[top], 1 + (axis + 2) % 3, -1)[:, :, :, 1]
    assert along.max() < 0.8**2 + 1e-12
    mesh.invert()
    np.testing.assert_allclose(fill([body_of(mesh)], 0.1).fills, expected.fills, atol=1e-12)


def test_no_fill_is_less_than_the_least_and_rounding_leaves_whole_cells_whole():
    cages = fill([body_of(BODIES["ball"])], 0.1)
    assert cages.fills.min() == LEAST_FILL and (cages.fills[cages.kind != BOUNDARY] == 1).all()
    aligned = trimesh.creation.box(bounds=[[0.1, 0.2, 0.3], [1.0, 0.9, 0.8]])
    assert (fill([body_of(aligned)], 0.1).fills == 1).all()


def test_an_open_surface_is_sampled_to_about_a_hundredth():
    ball = trimesh.creation.icosphere(4)
    closed = fill([body_of(ball)], 0.2)
    ball.update_faces(np.arange(len(ball.faces)) > 3)
    sampled = fill([body_of(ball)], 0.2)
    assert np.array_equal(sampled.ijk, closed.ijk)
    error = (sampled.fills - closed.fills).mean(axis=(1, 2, 3))
    assert np.sqrt((error**2).mean()) < 0.02 and volume(sampled) == pytest.approx(
        volume(closed), rel=0.01
    )


def test_triangles_wound_against_each_other_are_sampled():
    ball = trimesh.creation.icosphere(3)
    right = volume(fill([body_of(ball)], 0.2))
    ball.faces[:7] = ball.faces[:7, ::-1]
    assert volume(fill([body_of(ball)], 0.2)) == pytest.approx(right, rel=0.05)


def test_an_open_surface_far_from_the_origin_weighs_as_near_it():
    ball = trimesh.creation.icosphere(3, radius=0.15)
    ball.update_faces(np.arange(len(ball.faces)) > 3)
    near = volume(fill([body_of(ball)], 0.04))
    ball.apply_translation([441871.6, 6329700.7, 120.3])
    assert volume(fill([body_of(ball)], 0.04)) == pytest.approx(near, rel=1e-3)


def moved(mesh: trimesh.Trimesh, by: float, inwards: bool = False) -> trimesh.Trimesh:
    mesh = mesh.copy().apply_translation([by, 0, 0])
    mesh.faces = mesh.faces[:, ::-1] if inwards else mesh.faces
    return mesh


BALL, CORE = BODIES["ball"], trimesh.creation.icosphere(2, radius=0.6)
PARTS = {
    "apart": ([BALL, moved(BALL, 3)], ""),
    "with a cavity": ([BALL, moved(CORE, 0.1, inwards=True)], ""),
    "all inwards": ([moved(BALL, 0, inwards=True), moved(BALL, 3, inwards=True)], ""),
    "of two windings": (
        [BALL, moved(BALL, 3), moved(BALL, 6, inwards=True)],
        "parts are wound inwards",
    ),
    "a sheet": ([trimesh.creation.box((1, 0.5, 1e-4))], "far thinner than a cell"),
    "in each other": ([BALL, moved(CORE, 0.1)], "parts overlap or lie in each other"),
    "over each other": ([BALL, moved(BALL, 1)], "parts overlap or lie in each other"),
}


@pytest.mark.parametrize("name", PARTS)
def test_parts_that_weigh_otherwise_than_the_mesh_are_told(
    name: str, caplog: pytest.LogCaptureFixture
):
    parts, words = PARTS[name]
    with caplog.at_level(logging.WARNING, "msmpetsc"):
        fill([body_of(trimesh.util.concatenate(parts))], 0.1)
    assert words in caplog.text and bool(words) == bool(caplog.text)


def test_the_body_whose_mass_is_most_off_is_told_once(caplog: pytest.LogCaptureFixture):
    """The warning names the cube whose mass is most off, on whole cells of 0.2 m.

    6^3 cells surround a cube of 1.1 m, 5^3 a cube of 1 m.
    """
    cubes = [body_of(trimesh.creation.box((side,) * 3)) for side in (1.0, 1.1)]
    box = trimesh.creation.box((1, 1, 1))
    box.update_faces(np.arange(12) > 0)
    holed = body_of(box)
    fill(cubes, 0.2)
    fill([holed, cubes[0]], 0.2, boundary="whole")
    assert "weigh" not in caplog.text
    fill([holed, *cubes], 0.2, boundary="whole")
    (line,) = [line for line in caplog.messages if "weigh" in line]
    assert line == (
        "the mesh of body.2 encloses 1.331 m^3, its cells hold 1.728 m^3 and weigh 1.3 times as "
        'much: cages.boundary = "whole" counts cut cells whole'
    )


@pytest.mark.parametrize("excess", [0.015, 0.025])
def test_a_fiftieth_of_the_mass_is_the_limit(excess: float, caplog: pytest.LogCaptureFixture):
    """A cube slightly shorter than ten whole cells has a mass just above or below the limit."""
    short = trimesh.creation.box((1, 1, 1 / (1 + excess)))
    fill([body_of(short)], 0.1, boundary="whole")
    assert ("weigh" in caplog.text) == (excess > 0.02)
