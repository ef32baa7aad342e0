"""Filling a surface with cells that it touches or encloses, on any number of ranks.

The reference for touched cells is a separating-axis test in integers, so nothing is rounded. A cell
is the half-open box [i, i+1)^3. A cell that is touched only at its far faces may be marked or not,
because rays interpolate there. So all cells of the half-open test must be marked, and no cells
beyond the closed test.
"""

import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh
from cages_worker import FILLED
from conftest import WORKERS, run
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage
from surfaces import body_of, surface_of

from msmpetsc.errors import InputError
from msmpetsc.geometry.cages import BOUNDARY, INTERIOR, BodySurface, Cages, fill
from msmpetsc.geometry.cell_size import choose_cell_size
from msmpetsc.geometry.embedding import embed
from msmpetsc.geometry.grid import unpacked
from msmpetsc.geometry.morton import COPIES
from msmpetsc.geometry.prepare import prepare
from msmpetsc.geometry.readers import read_surface
from msmpetsc.geometry.surface import Surface
from msmpetsc.geometry.valid_cells import touched_cells
from msmpetsc.lattice.topology import topology_of

WORKER = WORKERS / "cages_worker.py"
MESHES = Path(os.environ.get("MSMPETSC_MESH_DIR", ""))
with_meshes = pytest.mark.skipif(
    "MSMPETSC_MESH_DIR" not in os.environ, reason="needs $MSMPETSC_MESH_DIR"
)
# cells of the small grid of the boundary tests
SIDE = 6


# --- boundary cells ---


def cells_of(corners: np.ndarray) -> set[tuple[int, ...]]:
    triangles = np.atleast_3d(corners).reshape(-1, 3, 3)
    keys, _ = touched_cells(triangles, np.zeros(3, int), np.full(3, SIDE))
    return set(map(tuple, unpacked(keys).tolist()))


# corners of the reference triangles are multiples of 1/64
UNIT = 64
# a half-open cell ends 1/64 * 2^-34 before its far faces
FINE = 1 << 34


def boxes_touched(triangle: np.ndarray, gap: int) -> set[tuple[int, ...]]:
    """Return which boxes [i, i + 1 - gap / (64 * 2^34)] a triangle (3, 3) [1/64 cell] touches.

    Separating axes, Akenine-Moller 2001, in integers below 2^63.
    """
    cells = np.stack(np.indices((SIDE,) * 3), -1).reshape(-1, 3)
    low, high = cells * UNIT * FINE, (cells + 1) * UNIT * FINE - gap
    edges = np.roll(triangle, -1, axis=0) - triangle
    crossed = np.cross(edges[:, None], np.eye(3, dtype=np.int64)).reshape(9, 3)
    axes = np.concatenate([np.eye(3, dtype=np.int64), np.cross(edges[:1], edges[1:2]), crossed])
    at = axes @ (triangle.T * FINE)
    nearest = np.minimum(axes * low[:, None], axes * high[:, None]).sum(-1)
    farthest = np.maximum(axes * low[:, None], axes * high[:, None]).sum(-1)
    misses = (at.max(1) < nearest) | (at.min(1) > farthest)
    return set(map(tuple, cells[~misses.any(1)].tolist()))


off_planes = st.integers(0, SIDE * UNIT // 2 - 1).map(lambda x: 2 * x + 1)
often_on_planes = st.integers(0, SIDE * 4 - 1).map(lambda x: 16 * x)


# no deadline, because the first example compiles
@settings(max_examples=300, deadline=None)
@given(
    st.one_of(
        *(arrays(np.int64, (3, 3), elements=place) for place in (off_planes, often_on_planes))
    )
)
def test_touched_cells_are_those_of_a_separating_axis_test(triangle):
    assert boxes_touched(triangle, 1) <= cells_of(triangle / UNIT) <= boxes_touched(triangle, 0)


# --- interior cells ---


def dense(cages: Cages, kind: int) -> np.ndarray:
    grid = np.zeros(cages.grids.grids[0].shape, bool)
    grid[tuple(cages.ijk[cages.kind == kind].T)] = True
    return grid


def hollow_ball(turned: bool) -> trimesh.Trimesh:
    shell, cavity = (
        trimesh.creation.icosphere(3, radius=1.0),
        trimesh.creation.icosphere(3, radius=0.6),
    )
    if turned:
        cavity.invert()
    return trimesh.util.concatenate([shell, cavity])


def two_balls() -> trimesh.Trimesh:
    far = trimesh.creation.icosphere(2).apply_translation([0.3, 2.5, 0.1])
    return trimesh.util.concatenate([trimesh.creation.icosphere(2), far])


UPRIGHT = trimesh.transformations.rotation_matrix(1.3, [1, 1, 0])
SHAPES = {
    "torus": (trimesh.creation.torus(1.0, 0.35), 0.06),
    "torus upright": (trimesh.creation.torus(1.0, 0.35).apply_transform(UPRIGHT), 0.06),
    "two balls": (two_balls(), 0.08),
    "one cell": (trimesh.creation.icosphere(2), 2.5),
}


def enclosed(boundary: np.ndarray) -> np.ndarray:
    """Return cells that a dense flood fill from outside does not reach, without boundary cells."""
    label, _ = ndimage.label(np.pad(~boundary, 1, constant_values=True))
    return ((label != label[0, 0, 0]) & (label != 0))[1:-1, 1:-1, 1:-1]


@pytest.mark.parametrize("name", SHAPES)
def test_interior_is_what_a_dense_flood_fill_finds(name):
    mesh, cell_size = SHAPES[name]
    cages = fill([body_of(mesh)], cell_size, boundary="whole")
    assert np.array_equal(dense(cages, INTERIOR), enclosed(dense(cages, BOUNDARY)))


@pytest.mark.parametrize("turned", [True, False])
@pytest.mark.parametrize("boundary", ["whole", "fill"])
def test_a_cavity_is_filled_but_where_it_is_wound_as_one(turned, boundary):
    cages = fill([body_of(hollow_ball(turned))], 0.1, boundary=boundary)
    middle = np.floor((0 - cages.grids.grids[0].origin) / 0.1).astype(int)
    assert dense(cages, INTERIOR)[tuple(middle)] != turned


def test_time_and_memory_follow_the_cells_not_the_bounding_box():
    # a rod of 35,000 x 3 x 3 cells along the diagonal of a grid of 20,000^3; one bit
    # for each cell of the grid would be 1 TB
    ends = np.array([[0, 0, 0], [20_000, 20_000, 20_000]])
    body = body_of(trimesh.creation.cylinder(radius=1.5, segment=ends, sections=5))
    # compile before the measurement
    fill([body], 2000.0)
    tracemalloc.start()
    cages = fill([body], 1.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert cages.grids.grids[0].shape.min() >= 20_000 and (cages.kind == INTERIOR).sum() > 10_000
    # bytes; the peak occurs while triangles are cut into pieces of 17 sums each
    assert peak < 800 * len(cages.kind)


# --- cages ---


def aligned_box(lid: bool = True) -> BodySurface:
    box = trimesh.creation.box((1, 0.5, 0.3))
    box.vertices = np.array([1, 0.5, 0.3]) * (box.vertices > 0)
    if not lid:
        box.update_faces(~(box.vertices[box.faces][:, :, 2] == 0.3).all(axis=1))
    return body_of(box)


def test_an_aligned_box_is_filled_with_its_own_cells():
    cages = fill([aligned_box()], 0.1)
    assert (
        cages.grids.grids[0].shape.tolist() == [10, 5, 3]
        and len(cages.kind) == cages.table.total == 150
    )
    assert (cages.kind == INTERIOR).sum() == 8 * 3 * 1
    assert np.array_equal(dense(cages, BOUNDARY), ~np.pad(np.ones((8, 3, 1), bool), 1))


def single(surface: Surface) -> Surface:
    """Return the mesh with coordinates in single precision, as in a file."""
    return Surface(surface.points.astype(np.float32).astype(float), surface.triangles)


def l_shape() -> Surface:
    """Return a square of 3 x 3 cells of 0.1 m, a layer high, without its upper 2 x 2."""
    corners = np.array([[0, 0], [0.3, 0], [0.3, 0.1], [0.1, 0.1], [0.1, 0.3], [0, 0.3]])
    cuts = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    low, high = (np.column_stack([corners, np.full(6, height)]) for height in (0, 0.1))
    sides = [[a, (a + 1) % 6, 6 + a] for a in range(6)] + [
        [(a + 1) % 6, 6 + (a + 1) % 6, 6 + a] for a in range(6)
    ]
    return Surface(np.vstack([low, high]), np.vstack([cuts[:, ::-1], cuts + 6, sides]))


@pytest.mark.parametrize("shift", [0.0, 0.7, 3.0])
@pytest.mark.parametrize("shape", ["box", "l"])
def test_a_size_that_divides_a_body_divides_its_copies_in_single_precision(shape, shift):
    """A size that divides a body also divides its scaled, turned and moved copies."""
    mesh = (
        surface_of(trimesh.creation.box(bounds=[[0, 0, 0], [0.3, 0.2, 0.1]]))
        if shape == "box"
        else l_shape()
    )
    moved = single(Surface(mesh.points + shift, mesh.triangles))
    quarter = [{"rotate": {"axis": [0, 1, 0], "degrees": 90}}]
    eighths = [{"rotate": {"axis": [0, 0, 1], "degrees": degrees}} for degrees in (30, -30)]
    for steps, size, base in (
        ([], None, None),
        ([], 0.6, None),
        ([], None, (0, 0, 5)),
        (quarter, None, None),
        (eighths, None, None),
        (eighths, 1.0, (7, 8, 9)),
    ):
        expected = fill([body_of(prepare(mesh, steps, size))], (size or 0.3) / 3)
        surface = prepare(moved, steps, size, base)
        cages = fill([body_of(surface)], (size or 0.3) / 3)
        assert np.array_equal(cages.ijk, expected.ijk)
        assert embed([surface.points], cages, topology_of(cages).table, "affine").shape[0] == len(
            surface.points
        )


def test_a_body_that_ends_beyond_a_plane_has_cells_there():
    assert len(fill([body_of(trimesh.creation.box((0.3, 0.3, 0.3 + 1e-5)))], 0.1).kind) == 36


def test_without_its_lid_the_winding_number_fills_the_box():
    body = aligned_box(lid=False)
    assert not body.report.closed
    cages = fill([body], 0.1)
    assert len(cages.kind) == 150
    # one layer more, because no triangle marks the upper layer as boundary
    assert (cages.kind == INTERIOR).sum() == 8 * 3 * 2


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Cages]]:
    """Return the folder with the worker's meshes, and their cells on a single rank."""
    folder, cages = tmp_path_factory.mktemp("filled"), {}
    for name, cell_size in FILLED:
        mesh = SHAPES["one cell" if name == "one cell" else "torus upright"][0].copy()
        if name == "open":
            mesh.update_faces(np.arange(len(mesh.faces)) > 20)
        body = body_of(mesh)
        np.savez(
            folder / f"{name}.npz", points=body.surface.points, triangles=body.surface.triangles
        )
        cages[name] = fill([body], cell_size)
    return folder, cages


@pytest.mark.parametrize("ranks", [3, pytest.param(5, marks=pytest.mark.slow)])
def test_ranks_find_the_same_cells_in_the_same_order(filled, ranks):
    folder, serial = filled
    done = run(ranks, "-m", "mpi4py", WORKER, folder, status=0)
    assert done.stdout.count("passed") == ranks
    for name, cages in serial.items():
        with np.load(folder / f"{name}.cells.npz") as cells:
            assert np.array_equal(cells["ijk"], cages.ijk) and np.array_equal(
                cells["kind"], cages.kind
            ), name
            assert np.array_equal(cells["fills"], cages.fills), name
    assert len(serial["one cell"].kind) == 1


def test_too_many_cells_are_refused():
    with pytest.raises(InputError, match=r"above cages.max_cells = 149"):
        fill([aligned_box()], 0.1, max_cells=149)
    assert len(fill([aligned_box()], 0.1, max_cells=150).kind) == 150
    with pytest.raises(InputError, match=r"above cages.max_cells"):
        # the error comes at once, without an attempt at 1.5e14 cells
        fill([aligned_box()], 1e-5)
    with pytest.raises(InputError, match=r"cages.cell_size: 1e-08 m would cut the body into 1e"):
        fill([aligned_box()], 1e-8)


# --- cell size ---


@with_meshes
@pytest.mark.parametrize("count", [1000, 9946])
@pytest.mark.parametrize("name", ["armadillo", "heart", "lung"])
def test_the_cell_size_gives_the_wanted_number_of_cells(name, count):
    body = body_of(read_surface(MESHES / f"{name}.ply"))
    cages = fill([body], choose_cell_size([body], count))
    # copies of cells at slits come in addition
    assert len(np.unique(cages.table.keys // COPIES)) == pytest.approx(count, rel=0.01)


@pytest.mark.parametrize("count", [4, 5, 28, 32])
def test_a_bar_gets_each_number_that_it_can_have(count):
    bar = body_of(trimesh.creation.box((1, 0.2, 0.2)))
    assert fill([bar], choose_cell_size([bar], count)).table.total == count


def test_a_number_that_no_size_gives_is_told_and_the_nearest_taken(caplog):
    # a cube has its own k^3 cells and no other number; 20 lies between 8 and 27
    cube = body_of(trimesh.creation.box((1, 1, 1)))
    with caplog.at_level("WARNING", logger="msmpetsc"):
        cages = fill([cube], choose_cell_size([cube], 20))
    assert cages.table.total == 27
    assert "20 cells within 1%; taking 27" in caplog.text


def test_more_cells_than_allowed_are_not_sought():
    with pytest.raises(InputError, match=r"cages.count: 151 is more than cages.max_cells = 150"):
        choose_cell_size([aligned_box()], 151, max_cells=150)
