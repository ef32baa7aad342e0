#!/usr/bin/env python3
"""Compares the embeddings and prints a Markdown table: accuracy, smoothness, speed.

rms: distance between a bar bent to an arc and its embedding, over points in the cells at the bar's surface.
kink: jump of the normal derivative across shared faces, rms, nodes moved at random by 0.1 cells (an axis).
jump: greatest distance between two cells' answers for a point they share, same nodes, any set of cells.
"""

import time

from clone import parser

import numpy as np

from msmpetsc.geometry.embedding import KINDS, stencil_weights

COMPARED = ("trilinear", *KINDS)
BAR = np.array([4, 1, 1])  # sides [m]
RADIUS = 3.0  # of the bent bar's middle [m]
SIZES = np.array([1 / 2, 1 / 4, 1 / 8, 1 / 16])  # cell size [m]
MOVED = 0.1  # standard deviation of random node displacements [cells]
STEP = 1e-4  # of the one-sided differences [cells]
BLOCK = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(27, 3)
NODES = np.stack(np.meshgrid(*[range(-1, 3)] * 3, indexing="ij"), -1).reshape(64, 3)


def trilinear_weights(u):
    """(p,64), columns as in stencil_weights."""
    near = np.maximum(1.0 - np.abs(u[:, None] - NODES), 0.0)
    return near.prod(-1)


def weights_of(kind, u, neighbours):
    """stencil_weights, or trilinear for comparison."""
    return trilinear_weights(u) if kind == "trilinear" else stencil_weights(kind, u, neighbours)


def neighbours_of(valid, cells):
    """(p,27) bool of cells (p,3); valid (nx,ny,nz) bool with a margin of one cell that is not."""
    return valid[tuple(np.moveaxis(cells[:, None] + BLOCK, -1, 0))]


def place(kind, valid, nodes, cells, u):
    """Embedded points (p,3): valid as above, nodes (nx+1,ny+1,nz+1,3) positions, points at u (p,3) in cells (p,3)."""
    weights = weights_of(kind, u, neighbours_of(valid, cells))
    around = nodes[tuple(np.moveaxis(cells[:, None] + NODES, -1, 0))]
    return np.einsum("pk,pkx->px", weights, around)


def block_of_cells(shape):
    """valid with a margin, True inside."""
    return np.pad(np.ones(shape, bool), 1)


def random_cells(rng, shape=(6, 6, 6), share=0.5):
    """valid with a margin, True at random: cells that touch at faces, at edges, at corners, or nowhere."""
    return np.pad(rng.random(shape) < share, 1)


def moved_nodes(rng, valid, moved=MOVED):
    """Grid points, moved at random. [cells]"""
    grid = np.moveaxis(np.indices(np.array(valid.shape) + 1), 0, -1).astype(float)
    return grid + moved * rng.standard_normal(grid.shape)


def bend(X):
    """The bar (its axis along x) bent to an arc in the x-z plane, about RADIUS below its middle. [m]"""
    angle, radius = X[..., 0] / RADIUS, RADIUS + X[..., 2] - BAR[2] / 2
    return np.stack([radius * np.sin(angle), X[..., 1], radius * np.cos(angle) - RADIUS], -1)


def rms_error(kind, size, points=20_000):
    """rms distance [m] of the embedded points from the bent bar's."""
    rng = np.random.default_rng(1)
    valid = block_of_cells(np.rint(BAR / size).astype(int))
    nodes = bend((np.moveaxis(np.indices(np.array(valid.shape) + 1), 0, -1) - 1) * size)
    cells = np.argwhere(valid)
    at_surface = cells[~neighbours_of(valid, cells).all(1)]
    chosen = at_surface[rng.integers(len(at_surface), size=points)]
    u = rng.random((points, 3))
    error = place(kind, valid, nodes, chosen, u) - bend((chosen - 1 + u) * size)
    return np.sqrt((error**2).sum(1).mean())


def shared(rng, valid, offsets, points):
    """Cells (p,3), their valid neighbours (p,3) at one of the offsets, and u (p,3) in the first, shared by both."""
    pairs = [(cell, cell + offset) for offset in offsets for cell in np.argwhere(valid) if valid[tuple(cell + offset)]]
    first, second = np.array(pairs)[rng.integers(len(pairs), size=points)].swapaxes(0, 1)
    offset = second - first
    u = np.where(offset == 0, rng.uniform(0.05, 0.95, offset.shape), offset > 0)
    return first, second, u


def position_jump(kind, valid, points=3000):
    """Greatest distance [cells] between the answers of two cells for a point on a face, edge or corner of both."""
    rng = np.random.default_rng(2)
    nodes = moved_nodes(rng, valid)
    first, second, u = shared(rng, valid, BLOCK[14:], points)
    one = place(kind, valid, nodes, first, u)
    other = place(kind, valid, nodes, second, u - (second - first))
    return np.linalg.norm(one - other, axis=1).max()


def kinks(kind, valid, points=2000):
    """Jumps (p,) of the derivative along the normal across shared faces, from one-sided second-order differences."""
    rng = np.random.default_rng(3)
    nodes = moved_nodes(rng, valid)
    first, second, u = shared(rng, valid, np.eye(3, dtype=int), points)
    normal = second - first
    slopes = []
    for cells, at, inwards in ((first, u, -normal), (second, u - normal, normal)):
        f0, f1, f2 = (place(kind, valid, nodes, cells, at + inwards * STEP * i) for i in range(3))
        slopes.append((-3 * f0 + 4 * f1 - f2) / (2 * STEP))
    return np.linalg.norm(slopes[0] + slopes[1], axis=1)


def seconds(kind, points=50_000):
    """CPU time [s] of the weights of points with all neighbours valid (the slowest case), compiled before."""
    u, neighbours = np.random.default_rng(4).random((points, 3)), np.ones((points, 27), bool)
    weights_of(kind, u[:1], neighbours[:1])
    times = []
    for _ in range(3):
        start = time.process_time()
        weights_of(kind, u, neighbours)
        times.append(time.process_time() - start)
    return min(times)


def main() -> None:
    parser(__doc__).parse_args()
    columns = [f"rms h={size:g} m" for size in SIZES]
    columns += ["slope", "kink", "kink, any cells", "jump, any cells", "50,000 points [s]"]
    print("| embedding |", " | ".join(columns), "|")
    print("|---" * (len(columns) + 1) + "|")
    full, any_cells = block_of_cells((4, 3, 3)), random_cells(np.random.default_rng(0))
    smooth = {}
    for kind in COMPARED:
        rms = [rms_error(kind, size) for size in SIZES]
        kink, kink_any = (np.sqrt((kinks(kind, valid) ** 2).mean()) for valid in (full, any_cells))
        row = [f"{error:.2e}" for error in rms] + [f"{np.polyfit(np.log(SIZES), np.log(rms), 1)[0]:.2f}"]
        row += [f"{kink:.1e}", f"{kink_any:.1e}", f"{position_jump(kind, any_cells):.0e}", f"{seconds(kind):.2f}"]
        print(f"| {kind} |", " | ".join(row), "|")
        if max(kink, kink_any) < 1e-3:
            smooth[kind] = rms[-1]
    print(f"\nBest, of those without kink by accuracy: {min(smooth, key=lambda kind: smooth[kind])}.")


if __name__ == "__main__":
    main()
