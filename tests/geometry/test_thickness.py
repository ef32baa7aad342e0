"""Thickness by rays: exact for simple bodies, warnings of thin walls, bending of oblique strips."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from few_cells import bent_strip
from surfaces import body_of, surface_of
from trimesh.transformations import rotation_matrix

from msmpetsc.geometry.cages import BodySurface
from msmpetsc.geometry.cell_size import choose_cell_size, warn_of_thin_bodies
from msmpetsc.geometry.surface import examine
from msmpetsc.geometry.thickness import ENOUGH, Thickness, thickness_of
from msmpetsc.scene.body import SOLID

SPRINGS = "linear"


def measured(mesh: trimesh.Trimesh) -> Thickness | None:
    surface = surface_of(mesh)
    return thickness_of(surface, examine(surface))


def thick_body(mesh: trimesh.Trimesh) -> BodySurface:
    return replace(body_of(mesh), thickness=measured(mesh))


def slab(degrees: float, thickness: float = 0.1) -> trimesh.Trimesh:
    """Return a slab of 1 x 1 m, turned about an axis of the grid."""
    turn = rotation_matrix(np.radians(degrees), (0, 1, 0))
    return trimesh.creation.box((1, 1, thickness)).apply_transform(turn)


@pytest.mark.parametrize("move", [np.array, lambda x: 1e-20 * x, lambda x: 1e5 + x])
@pytest.mark.parametrize("inwards", [False, True])
def test_slabs_and_balls_are_as_thick_as_they_are(inwards: bool, move: Callable):
    for mesh, exact, askew in (
        (slab(0), 0.1, np.inf),
        (slab(30), 0.1, 0.1 / np.sin(np.radians(60))),
        (slab(45), 0.1, 0.1),
        # its facets lie 0.1% inside the ball
        (trimesh.creation.icosphere(5, 0.5), 1.0, 1.0),
    ):
        scale = np.ptp(move(mesh.vertices), axis=0).max() / np.ptp(mesh.vertices, axis=0).max()
        mesh.vertices = move(mesh.vertices)
        if inwards:
            mesh.invert()
        found = measured(mesh)
        assert found is not None
        assert [found.median, found.thin] == pytest.approx(2 * [scale * exact], rel=2e-3)
        if np.isinf(askew):
            assert found.askew > 1e4 * exact * scale
        else:
            assert found.askew == pytest.approx(scale * askew, rel=0.01)


def test_the_tenth_and_the_median_of_two_slabs():
    """A fifth of the area belongs to the thin slab, a few hundredths to edges."""
    thin = slab(0, 0.02).apply_scale([0.5, 0.5, 1]).apply_translation([3, 0, 0])
    found = measured(trimesh.util.concatenate([slab(0), thin]))
    assert found is not None
    assert [found.thin, found.median] == pytest.approx([0.02, 0.1])


def test_small_triangles_are_seen():
    """Cubes of 0.5 mm along a metre have triangles of 1e-7 of its square."""
    cube = trimesh.creation.box((5e-4,) * 3)
    row = [cube.copy().apply_translation([x, 0, 0]) for x in np.linspace(0, 1, 50)]
    found = measured(trimesh.util.concatenate(row))
    assert found is not None and found.median == pytest.approx(5e-4, rel=1e-3)


def test_an_open_body_has_no_thickness(caplog):
    mesh = slab(45)
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    assert measured(mesh) is None
    warn_of_thin_bodies([thick_body(mesh)], 1.0, SOLID)
    assert not caplog.messages


@pytest.mark.parametrize("law", [SOLID, SPRINGS])
def test_the_thinnest_body_is_told_once_and_the_advice_ends_it(law: str, caplog):
    meshes = trimesh.creation.box((1, 1, 1)), slab(30, 0.4), slab(40, 0.3)
    bodies = [thick_body(mesh) for mesh in meshes]
    warn_of_thin_bodies(bodies, 0.3, law)
    (line,) = caplog.messages
    assert "a tenth of body.2 is so thin" in line
    count, size = (
        float(re.search(f"{name} = ([^ ]*)", line)[1]) for name in ("count", "cell_size")
    )
    warn_of_thin_bodies(bodies, size, law)
    warn_of_thin_bodies(bodies, choose_cell_size(bodies, round(count)), law)
    assert sum("of theory" in line for line in caplog.messages) == 1
    warn_of_thin_bodies(bodies, 1.2 * size, law)
    assert sum("of theory" in line for line in caplog.messages) == 2


def test_walls_along_the_grid_are_thin_for_springs_alone(caplog):
    warn_of_thin_bodies([thick_body(slab(0))], 0.1, SOLID)
    assert not caplog.messages
    warn_of_thin_bodies([thick_body(slab(0))], 0.1, SPRINGS)
    assert "so thin that it bends by about 0.44 of theory" in caplog.text


@pytest.mark.parametrize("degrees", [10, 30, 45])
@pytest.mark.parametrize("thickness", [3, 1.5, 1])
def test_strips_across_the_grid_that_bend_too_little_are_told(degrees: float, thickness: float):
    """The estimate is within 0.05, and too small at small angles.

    The strips of 3 cells at 30 and 45 degrees are within 0.02 of the limit.
    """
    strip = trimesh.creation.box((20, 3, thickness))
    found = measured(strip.apply_transform(rotation_matrix(np.radians(degrees), (0, 1, 0))))
    assert found is not None
    told, real = found.bending(1.0, SOLID), bent_strip(thickness, degrees, 0.25)
    assert told == pytest.approx(real, abs=0.05)
    assert told < ENOUGH or real > ENOUGH
    # a wall of three cells at 30 degrees suffices, and so do walls that are thicker
    # across the grid
    assert (told >= ENOUGH) == (thickness / np.sin(np.radians(2 * degrees)) > 3.4)
