"""Embedding weights: exactness, continuity, smoothness, accuracy, and Eq. 1-9 evaluated plainly."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msmpetsc.geometry.embedding import stencil_weights

KINDS = ("mvc", "cages", "affine")
# sides of a bar [m], and the radius to which its middle is bent [m]
BAR, RADIUS = np.array([4, 1, 1]), 3.0
# cell size [m]
SIZES = np.array([1 / 2, 1 / 4, 1 / 8, 1 / 16])
# standard deviation of random displacements and step of differences on a side [cells]
MOVED, STEP = (
    0.1,
    1e-4,
)
BLOCK = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(27, 3)
NODES = np.stack(np.meshgrid(*[range(-1, 3)] * 3, indexing="ij"), -1).reshape(64, 3)
ALL_KINDS = pytest.mark.parametrize("kind", KINDS)
SMOOTH_KINDS = pytest.mark.parametrize("kind", ["cages", "affine"])

near_face = st.sampled_from([0.0, 1e-300, 1e-16, 3e-14, 1e-13, 1e-12, 1e-9, 1e-5, 0.00999, 0.01001])
coordinate = st.one_of(near_face, near_face.map(lambda x: 1 - x), st.just(0.5), st.floats(0, 1))
local_points = st.tuples(coordinate, coordinate, coordinate)
# every cell of the block touches the middle cell, so any set of them is connected
neighbour_masks = st.lists(st.booleans(), min_size=27, max_size=27).map(
    lambda m: [*m[:13], True, *m[14:]]
)


def weights(kind, u, mask, smoothing=1.0):
    """Return the weights (64,) of a point."""
    return stencil_weights(kind, np.array([u], float), np.array([mask], bool), smoothing)[0]


def random_masks(rng, count):
    masks = rng.random((count, 27)) < rng.choice([0.1, 0.5, 0.9], (count, 1))
    masks[:, 13] = True
    return masks


def exists(masks):
    """Return the mask (p,64) of nodes that belong to a valid cell."""
    has_node = ((NODES - BLOCK[:, None] >= 0) & (NODES - BLOCK[:, None] <= 1)).all(-1)
    return masks @ has_node > 0


# ---- a direct evaluation of Eq. 1-9, cell by cell, triangle by triangle


def surface_triangles(cells):
    """Return outward triangles, as nodes, of a union of cells (set of low corners).

    Squares are cut from low to high corner.
    """
    triangles = []
    for cell in cells:
        for axis, end in np.ndindex(3, 2):
            outwards = np.eye(3, dtype=int)[axis] * (2 * end - 1)
            if tuple(cell + outwards) not in cells:
                a, b = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
                low = np.array(cell) + end * np.eye(3, dtype=int)[axis]
                for pair in ((low + a, low + a + b), (low + a + b, low + b)):
                    triangles.append((low, *(pair if end else pair[::-1])))
    return triangles


def plain_mvc(p, cells):
    """Return the weights (64,) of Eq. 2-5; cells: set of low corners."""
    w = np.zeros(64)
    for triangle in surface_triangles(cells):
        e = [(v - p) / np.linalg.norm(v - p) for v in triangle]
        # angle opposite to vertex i
        beta = [np.arccos(e[i - 2] @ e[i - 1]) for i in range(3)]
        n = [np.cross(e[i - 2], e[i - 1]) for i in range(3)]
        n = [x / np.linalg.norm(x) for x in n]
        for i, v in enumerate(triangle):
            mu = sum(beta[j] * n[j] @ n[i] for j in range(3)) / (2 * e[i] @ n[i])
            w[(v + 1) @ (16, 4, 1)] += mu / np.linalg.norm(v - p)
    return w / w.sum()


def plain_cages(p, mask, h):
    """Return the weights (64,) of Eq. 7-9."""
    valid = {tuple(offset) for offset in BLOCK[mask]}
    corners = [np.array(v) for v in np.ndindex(2, 2, 2)]
    around = {tuple(v): {c for c in valid if all(v - c >= 0) and all(v - c <= 1)} for v in corners}
    own = plain_mvc(p, {(0, 0, 0)})
    b, step = 1.0, lambda z: z * z * (3 - 2 * z)
    for c in valid - {(0, 0, 0)}:
        b *= 1 - sum(own[(v + 1) @ (16, 4, 1)] for v in corners if c in around[tuple(v)])
    b = step(min(b / h, 1))
    blends = [step(1 - abs(p - v)).prod() if len(around[tuple(v)]) > 1 else 0 for v in corners]
    if not any(blends):
        return own
    joined = sum(
        W * plain_mvc(p, around[tuple(v)]) for v, W in zip(corners, blends, strict=True) if W
    )
    return b * own + (1 - b) * joined / sum(blends)


def test_mvc_and_cages_agree_with_their_equations_evaluated_plainly():
    rng = np.random.default_rng(0)
    points = [
        *rng.uniform(0.05, 0.95, (2, 3)),
        np.array([0.005, 0.4, 0.7]),
        np.array([0.3, 0.995, 0.002]),
    ]
    masks = random_masks(rng, len(points))
    # four of the corners are outside B_c
    masks[0] = np.isin(np.arange(27), [13, 14])
    for u, mask in zip(points, masks, strict=True):
        np.testing.assert_allclose(weights("mvc", u, mask), plain_mvc(u, {(0, 0, 0)}), atol=1e-10)
        for h in (1.0, 0.4):
            np.testing.assert_allclose(
                weights("cages", u, mask, h), plain_cages(u, mask, h), atol=1e-10
            )


def test_affine_agrees_with_least_squares_at_each_corner():
    rng = np.random.default_rng(7)
    for u, mask in zip(rng.random((10, 3)), random_masks(rng, 10), strict=True):
        x, expected = rng.standard_normal(64), 0.0
        for v in np.array(list(np.ndindex(2, 2, 2))):
            around = mask & ((v - BLOCK >= 0) & (v - BLOCK <= 1)).all(1)
            nodes = NODES[exists(around[None])[0]]
            values = x[(nodes + 1) @ (16, 4, 1)] - x[(v + 1) @ (16, 4, 1)]
            gradient = np.linalg.lstsq(nodes - v, values, rcond=None)[0]
            z = 1 - abs(u - v)
            expected += (z * z * (3 - 2 * z)).prod() * (
                x[(v + 1) @ (16, 4, 1)] + gradient @ (u - v)
            )
        assert weights("affine", u, mask) @ x == pytest.approx(expected, abs=1e-12)


# ---- properties of all kinds


@ALL_KINDS
@settings(max_examples=200, deadline=None)
@given(u=local_points, mask=neighbour_masks, smoothing=st.sampled_from([1.0, 0.3, 1e-3]))
def test_rows_sum_to_one_reproduce_linear_fields_and_use_only_nodes_there_are(
    kind, u, mask, smoothing
):
    found = weights(kind, u, mask, smoothing)
    assert abs(found.sum() - 1) < 1e-12
    np.testing.assert_allclose(found @ NODES, u, atol=1e-12, rtol=0)
    assert np.all(found[~exists(np.array([mask]))[0]] == 0.0)
    assert np.abs(found).max() < 20


@ALL_KINDS
def test_weights_know_no_direction(kind):
    """Swapping axes and point inversion change neither the cut of squares nor the weights."""
    rng = np.random.default_rng(2)
    u, masks = rng.random((50, 3)), random_masks(rng, 50)
    found = stencil_weights(kind, u, masks).reshape(50, 4, 4, 4)
    for order in permutations(range(3)):
        turn = (0, *(axis + 1 for axis in order))
        turned_masks = masks.reshape(50, 3, 3, 3).transpose(turn).reshape(50, 27)
        turned = stencil_weights(kind, u[:, order], turned_masks).reshape(50, 4, 4, 4)
        np.testing.assert_allclose(turned, found.transpose(turn), atol=1e-12)
    inverted = stencil_weights(kind, 1 - u, masks[:, ::-1]).reshape(50, 4, 4, 4)
    np.testing.assert_allclose(inverted, found[:, ::-1, ::-1, ::-1], atol=1e-12)


# ---- across cells


def neighbours_of(valid, cells):
    """Return the mask (p,27) of the valid cells around cells (p,3).

    valid : (nx,ny,nz) bool, with a margin of invalid cells
    """
    return valid[tuple(np.moveaxis(cells[:, None] + BLOCK, -1, 0))]


def place(kind, valid, nodes, cells, u):
    """Return embedded points (p,3) at u (p,3) in cells (p,3).

    valid : as above
    nodes : (nx+1,ny+1,nz+1,3) positions
    """
    weights = stencil_weights(kind, u, neighbours_of(valid, cells))
    around = nodes[tuple(np.moveaxis(cells[:, None] + NODES, -1, 0))]
    return np.einsum("pk,pkx->px", weights, around)


def random_cells(rng, shape=(6, 6, 6), share=0.5):
    """Return a random mask of valid cells with a margin; they touch in all ways or nowhere."""
    return np.pad(rng.random(shape) < share, 1)


def moved_nodes(rng, valid):
    """Return the grid points [cells], moved at random."""
    grid = np.moveaxis(np.indices(np.array(valid.shape) + 1), 0, -1).astype(float)
    return grid + MOVED * rng.standard_normal(grid.shape)


def bend(X):
    """Return the points [m] after bending to an arc in the x-z plane, RADIUS below the middle."""
    angle, radius = X[..., 0] / RADIUS, RADIUS + X[..., 2] - BAR[2] / 2
    return np.stack([radius * np.sin(angle), X[..., 1], radius * np.cos(angle) - RADIUS], -1)


def rms_error(kind, size, points=4000):
    """Return the rms distance [m] of the embedded points from the bent bar."""
    rng = np.random.default_rng(1)
    valid = np.pad(np.ones(np.rint(BAR / size).astype(int), bool), 1)
    nodes = bend((np.moveaxis(np.indices(np.array(valid.shape) + 1), 0, -1) - 1) * size)
    cells = np.argwhere(valid)
    at_surface = cells[~neighbours_of(valid, cells).all(1)]
    chosen = at_surface[rng.integers(len(at_surface), size=points)]
    u = rng.random((points, 3))
    error = place(kind, valid, nodes, chosen, u) - bend((chosen - 1 + u) * size)
    return np.sqrt((error**2).sum(1).mean())


def shared(rng, valid, offsets, points):
    """Return cells (p,3), their valid neighbours (p,3) at an offset, and u (p,3) in the cells."""
    pairs = [
        (cell, cell + offset)
        for offset in offsets
        for cell in np.argwhere(valid)
        if valid[tuple(cell + offset)]
    ]
    first, second = np.array(pairs)[rng.integers(len(pairs), size=points)].swapaxes(0, 1)
    offset = second - first
    u = np.where(offset == 0, rng.uniform(0.05, 0.95, offset.shape), offset > 0)
    return first, second, u


def position_jump(kind, valid, points=3000):
    """Return the greatest distance [cells] between the results of two cells for a shared point."""
    rng = np.random.default_rng(2)
    nodes = moved_nodes(rng, valid)
    first, second, u = shared(rng, valid, BLOCK[14:], points)
    one = place(kind, valid, nodes, first, u)
    other = place(kind, valid, nodes, second, u - (second - first))
    return np.linalg.norm(one - other, axis=1).max()


def kinks(kind, valid, points=2000):
    """Return the jumps (p,) of the normal derivative across shared faces.

    They come from second-order differences on each side.
    """
    rng = np.random.default_rng(3)
    nodes = moved_nodes(rng, valid)
    first, second, u = shared(rng, valid, np.eye(3, dtype=int), points)
    normal = second - first
    slopes = []
    for cells, at, inwards in ((first, u, -normal), (second, u - normal, normal)):
        f0, f1, f2 = (place(kind, valid, nodes, cells, at + inwards * STEP * i) for i in range(3))
        slopes.append((-3 * f0 + 4 * f1 - f2) / (2 * STEP))
    return np.linalg.norm(slopes[0] + slopes[1], axis=1)


@ALL_KINDS
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_position_is_continuous_across_everything_that_cells_share(kind, share):
    """Positions are continuous on faces, edges and corners of cells that may touch only there."""
    rng = np.random.default_rng(4)
    valid = random_cells(rng, share=share)
    assert position_jump(kind, valid) < 1e-10
    first, second, u = shared(rng, valid, BLOCK[14:], 2000)
    nodes = moved_nodes(rng, valid)
    for cells, at in ((first, u), (second, u - (second - first))):
        inside = at + 1e-9 * (0.5 - at)
        moved = place(kind, valid, nodes, cells, inside) - place(kind, valid, nodes, cells, at)
        assert np.abs(moved).max() < 1e-7


@SMOOTH_KINDS
def test_slope_is_continuous_across_shared_faces(kind):
    for valid in (np.pad(np.ones((4, 3, 3), bool), 1), random_cells(np.random.default_rng(5))):
        assert kinks(kind, valid).max() < 1e-5


def test_mean_value_coordinates_alone_have_kinks():
    assert kinks("mvc", np.pad(np.ones((4, 3, 3), bool), 1)).mean() > 0.1


@ALL_KINDS
def test_error_on_a_bent_bar_falls_with_the_square_of_the_cell_size(kind):
    errors = [rms_error(kind, size) for size in SIZES]
    slope = np.polyfit(np.log(SIZES), np.log(errors), 1)[0]
    assert 1.8 < slope < 2.3
