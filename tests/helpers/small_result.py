"""A small result file for tests of readers: a bar of two cells whose frames follow formulas."""

from pathlib import Path

import numpy as np
from mpi4py import MPI

from msmpetsc.checkpoint import Checkpoint
from msmpetsc.fields import STRESS, Frame
from msmpetsc.results.writer import ResultFile

# cell size [m], time between frames [s], number of frames
H, DT, FRAMES = 0.5, 0.01, 5
CORNERS = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])
X = np.array([1, 0, 0])
# nodes (12, 3) [m]
NODES = H * np.unique(np.concatenate([CORNERS, CORNERS + X]), axis=0)
POINTS = np.array([[0.1, 0.2, 0.3], [0.6, 0.2, 0.1], [0.9, 0.4, 0.4], [0.5, 0.5, 0.5]])
SCENE = "[material]\ndensity = 1000\n\n[time]\nstep = 0.01\n"


def cells() -> np.ndarray:
    """Return the nodes (2, 8) of the cells."""
    return np.array([[number(H * (corner + x * X)) for corner in CORNERS] for x in (0, 1)])


def number(place: np.ndarray) -> int:
    """Return the number of the node at a place."""
    return int(np.argmin(np.linalg.norm(NODES - place, axis=1)))


def springs() -> np.ndarray:
    """Return the springs (s, 2) along the edges."""
    i, j = np.nonzero(np.isclose(np.linalg.norm(NODES[:, None] - NODES, axis=2), H))
    return np.column_stack([i, j])[i < j]


def position(index: int) -> np.ndarray:
    """Return the positions (12, 3) [m] of the bar, sheared by 0.1 more at each frame."""
    return NODES + 0.1 * index * NODES[:, [2]] * [1, 0, 0]


def frame(index: int, **other) -> Frame:
    """Return frame ``index``, with ``other`` values in place of its own."""
    energies = dict(kinetic=1.0 * index, elastic=2.0 * index, potential=-1.0, contact=0.0)
    numbers = dict(step_error=1e-6, iterations=3, ksp_its=9, wall_time=0.1 * index)
    arrays = dict(position=position(index), surface=POINTS + 0.01 * index * X)
    arrays |= dict(momentum=np.array([1.0, 0, index]))
    return Frame(**{"index": index, "time": DT * index, **energies, **numbers, **arrays, **other})


def write(
    path: Path,
    frames: list[Frame] | None = None,
    surface: bool = True,
    points: np.ndarray = POINTS,
    **lattice,
) -> Path:
    """Write the file, with other frames or other arrays of the lattice if they are given."""
    frames = [frame(index) for index in range(FRAMES)] if frames is None else frames
    s = len(springs())
    arrays = dict(nodes=NODES, cells=cells(), springs=springs(), mass=np.full(len(NODES), 0.25))
    arrays |= dict(rest_length=np.full(s, H), stiffness=np.full(s, 100.0))
    arrays |= dict(pinned=np.array([0, 3]), cell_kind=np.ones(2, "u1"))
    origin = {"scene": SCENE, "ranks": 1, "command": "msmpetsc run bar.toml"}
    with ResultFile(path, MPI.COMM_SELF, origin) as file:
        for name, rows in (arrays | lattice).items():
            file.write(f"lattice/{name}", rows)
        if surface:
            file.write("surface/points", points)
            file.write("surface/triangles", np.array([[0, 1, 2], [1, 2, 3]]))
            file.write("embedding/indptr", 8 * np.arange(len(POINTS) + 1))
            file.write("embedding/indices", cells()[[0, 1, 1, 0]].ravel())
            file.write("embedding/weights", np.full(8 * len(POINTS), 1 / 8))
        optional = {name: getattr(frames[0], name) for name in STRESS}
        also = {name: len(rows) for name, rows in optional.items() if rows is not None}
        also |= {"surface": len(POINTS)} if surface else {}
        file.start_frames(len(frames), len((arrays | lattice)["nodes"]), also)
        for one in frames:
            file.append(one)
            rows = {"q": one.position, "q_previous": one.position - 1}
            file.write_checkpoint(Checkpoint(one.index, rows))
    return path
