"""Write result files for test_writer.py on all ranks: frames_worker.py ACTION PATH."""

import os
import sys

import h5py
import numpy as np
from mpi4py import MPI

from msmpetsc.checkpoint import Checkpoint
from msmpetsc.errors import InputError
from msmpetsc.fields import Frame
from msmpetsc.results import layout, writer
from msmpetsc.results.writer import ResultFile

NODES, POINTS, STEPS = 23, 17, 9


def positions(index: int, rows: int) -> np.ndarray:
    """Return (rows, 3) values that show frame, row and axis."""
    return index + np.arange(3.0 * rows).reshape(rows, 3) / 1000


def frame(index: int, nodes: slice = slice(None), points: slice | None = slice(None)) -> Frame:
    """Return frame ``index`` of NODES nodes and POINTS surface points, the rows of a rank."""
    surface = None if points is None else -positions(index, POINTS)[points]
    numbers = dict(
        step_error=index / 7, iterations=index + 1, ksp_its=index + 2, wall_time=index / 3
    )
    energies = dict(
        kinetic=index + 0.1, elastic=index + 0.2, potential=index + 0.3, contact=index + 0.4
    )
    momentum = np.array([index, 1.0, 2.0])
    position = positions(index, NODES)[nodes]
    arrays = dict(position=position, surface=surface, momentum=momentum)
    return Frame(index=index, time=index / 60, **arrays, **numbers, **energies)


def share(rows: int) -> slice:
    """Return this rank's rows; if there are several, the last rank has none."""
    size, rank = MPI.COMM_WORLD.size, MPI.COMM_WORLD.rank
    cuts = np.linspace(0, rows, max(size - 1, 1) + 1).astype(int)
    return slice(cuts[rank], cuts[rank + 1]) if rank < len(cuts) - 1 else slice(rows, rows)


def write_all(path: str) -> None:
    # several chunks on each rank
    layout.CHUNK_BYTES = 5 * 24
    nodes, points = share(NODES), share(POINTS)
    with ResultFile(path, MPI.COMM_WORLD, {"scene": "title = 'a test'", "ranks": 3}) as file:
        file.write("lattice/nodes", positions(0, NODES)[nodes])
        file.write("lattice/springs", np.arange(2 * NODES).reshape(-1, 2)[nodes])
        file.write("lattice/pinned", np.zeros(0, int))
        file.start_frames(
            STEPS + 1, nodes.stop - nodes.start, {"surface": points.stop - points.start}
        )
        for index in range(STEPS + 1):
            file.append(frame(index, nodes, points))
            file.write_checkpoint(
                Checkpoint(
                    index,
                    {
                        "q": positions(index, NODES)[nodes],
                        "q_previous": positions(index - 1, NODES)[nodes],
                    },
                )
            )


def gather() -> None:
    """Make rank 0 write for all ranks, as if the ranks did not reach the same file."""
    writer.open_on_all_ranks = lambda *_: None


def refuse(path: str) -> None:
    """Print the InputError that each rank gets."""
    try:
        with ResultFile(path, MPI.COMM_WORLD, {}):
            pass
    except InputError as error:
        sys.stdout.write(f"refused: {error}\n")


def fill_disk(path: str, gathers: bool = True) -> None:
    """Fill the disk at the third frame while the ranks send their rows.

    Without gathering, it is full while a rank writes its own rows.
    """
    nodes = share(NODES)
    store = h5py.Dataset.__setitem__

    def half(file: int, data: memoryview, place: int) -> int:
        if MPI.COMM_WORLD.rank != 1:
            return write(file, data, place)
        if len(data) < 100:
            raise OSError(28, "No space left on device")
        return write(file, data[:100], place)

    def full(dataset, key, value):
        if dataset.name == "/frames/position":
            raise OSError(28, "No space left on device")
        store(dataset, key, value)

    try:
        with ResultFile(path, MPI.COMM_WORLD, {}) as file:
            file.start_frames(STEPS + 1, nodes.stop - nodes.start)
            for index in range(STEPS + 1):
                if index == 2 and gathers:
                    h5py.Dataset.__setitem__ = full
                elif index == 2:
                    write, os.pwrite = os.pwrite, half
                file.append(frame(index, nodes, None))
    except InputError as error:
        sys.stdout.write(f"refused: {error}\n")


if __name__ == "__main__":
    {
        "all": write_all,
        "gathered": lambda path: (gather(), write_all(path)),
        "refuse": refuse,
        "full": lambda path: (gather(), fill_disk(path)),
        "full for one": lambda path: fill_disk(path, gathers=False),
    }[sys.argv[1]](sys.argv[2])
