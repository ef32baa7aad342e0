"""Fill meshes under mpiexec, for test_cages.py: cages_worker.py FOLDER."""

import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI

from msmpetsc.geometry.cages import BodySurface, fill
from msmpetsc.geometry.surface import Surface, bounds_of, examine

comm = MPI.COMM_WORLD
FILLED = [("closed", 0.11), ("open", 0.11), ("one cell", 2.5)]


def body_of(path: Path) -> BodySurface:
    """Return a body from points and triangles in an .npz file, which only rank 0 holds."""
    data = np.load(path)
    surface = Surface(data["points"], data["triangles"])
    own = surface if comm.rank == 0 else None
    return BodySurface(comm, own, examine(surface), bounds_of(surface))


def fill_to_file(mesh: Path, cell_size: float) -> None:
    """Write all cells, in the order of the ranks, beside the mesh."""
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
    for name, cell_size in FILLED:
        fill_to_file(Path(sys.argv[1], name + ".npz"), cell_size)
    print("passed", flush=True)
