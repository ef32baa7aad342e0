"""Run under mpiexec: cages_worker.py FOLDER (of meshes) by test_cages.py."""

import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI
from scipy import ndimage

from msmpetsc.geometry.cages import BodySurface, fill
from msmpetsc.geometry.surface import Surface, examine
from msmpetsc.geometry.valid_cells import Slab, cells_of_gaps, enclosed_gaps, slab_edges

comm = MPI.COMM_WORLD
FILLED = [("closed", 0.11), ("open", 0.11), ("one cell", 2.5)]


def enclosed(boundary: np.ndarray) -> np.ndarray:
    """Return cells that a dense flood fill from outside does not reach, without the boundary.

    Grids are of bool.
    """
    label, _ = ndimage.label(np.pad(~boundary, 1, constant_values=True))
    return ((label != label[0, 0, 0]) & (label != 0))[1:-1, 1:-1, 1:-1]


def check_random_grids(shapes: list[tuple[int, int, int]], seeds: int) -> None:
    """Random boundary cells are labyrinths: a third to two thirds of the grid, where both phases
    percolate."""
    for shape in shapes:
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            boundary = rng.random(shape) < rng.uniform(0.3, 0.85)
            ends = slab_edges(comm.size, shape[0])
            slab = Slab(*ends[comm.rank : comm.rank + 2])
            cells = np.argwhere(boundary)
            assert (
                np.searchsorted(ends[1:], np.arange(slab.first, slab.last), side="right")
                == comm.rank
            ).all()
            own = cells[(cells[:, 0] >= slab.first) & (cells[:, 0] < slab.last)]
            found = cells_of_gaps(enclosed_gaps(comm, own, slab))
            expected = np.argwhere(enclosed(boundary))
            expected = expected[(expected[:, 0] >= slab.first) & (expected[:, 0] < slab.last)]
            assert np.array_equal(found, expected), (shape, seed, comm.rank)


def body_of(path: Path) -> BodySurface:
    """A body from points and triangles in an .npz file, which only rank 0 holds."""
    data = np.load(path)
    surface = Surface(data["points"], data["triangles"])
    bounds = np.array([surface.points.min(axis=0), surface.points.max(axis=0)])
    return BodySurface(comm, surface if comm.rank == 0 else None, examine(surface), bounds)


def fill_to_file(mesh: Path, cell_size: float) -> None:
    """Writes all cells in the order of the ranks beside the mesh."""
    cages = fill([body_of(mesh)], cell_size)
    assert comm.allreduce(len(cages.kind)) == cages.table.total
    parts = comm.gather((cages.table.first, cages.ijk, cages.kind, cages.fills))
    if comm.rank == 0:
        assert [part[0] for part in parts] == sorted(part[0] for part in parts)
        ijk, kind, fills = (
            np.concatenate([part[column] for part in parts]) for column in (1, 2, 3)
        )
        np.savez(mesh.with_suffix(".cells.npz"), ijk=ijk, kind=kind, fills=fills)


if __name__ == "__main__":
    check_random_grids([(7, 6, 8), (3, 9, 9), (16, 4, 5), (1, 5, 5)], seeds=6)
    for name, cell_size in FILLED:
        fill_to_file(Path(sys.argv[1], name + ".npz"), cell_size)
    print("passed", flush=True)
