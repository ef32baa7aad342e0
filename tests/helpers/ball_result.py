"""The result of a ball that falls and leaps, written by formulas without a run."""

from pathlib import Path

import numpy as np
import trimesh
from mpi4py import MPI

from msmpetsc.fields import Frame
from msmpetsc.results.writer import Begin, ResultFile

BARE = """
mesh.source = "ball"
cages.count = 1
material = { stiffness = 1.0, law = "linear", density = 1.0 }
time = { step = 0.1, duration = 1.0 }
"""
EAST_HELD = """
[[pin]]
region = { half_space = { point = [0.02, 0, 0], normal = [1, 0, 0] } }
"""
LED = """
[[anchor]]
region = { half_space = { point = [0, 0, 0.48], normal = [0, 0, -1] } }
path = [{ time = 1.0, by = [0, 0, 1] }]
stop = 0.5
"""
SCENE = f"""
{BARE}
[[obstacle]]
shape = "plane"
point = [0, 0, 0]
normal = [0, 0, 2]
[gravity]
acceleration = [0, 0, -9.81]
"""
# height of the middle [m] of a ball of radius 0.1 m that falls, touches the ground, is
# squashed, leaps and comes to rest
HEIGHTS = [0.5, 0.45, 0.3, 0.1, 0.07, 0.05, 0.08, 0.2, 0.35, 0.2, 0.1]
KINETIC = [0, 1, 4, 8, 4, 0, 5, 3, 0, 2, 0]
ELASTIC = [0, 0, 0, 0, 5, 9, 3, 0.1, 0.1, 0.1, 0]


def write_ball(path: Path, scene: str = SCENE) -> Path:
    """Write the result; points of the ball are also nodes, pinned if the scene has EAST_HELD."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    rows = len(ball.vertices)
    with ResultFile(path, MPI.COMM_SELF, {"scene": scene}, Begin.OVERWRITE) as file:
        file.write("surface/triangles", np.array(ball.faces))
        file.write("lattice/cells", np.zeros((1, 8), int))
        for name in ("surface/points", "lattice/nodes"):
            file.write(name, ball.vertices + np.array([0, 0, HEIGHTS[0]]))
        if EAST_HELD in scene:
            file.write("lattice/pinned", np.flatnonzero(ball.vertices[:, 0] >= 0.02))
        file.write("embedding/weights", np.ones(rows))
        file.write("embedding/indices", np.arange(rows, dtype="i4"))
        file.write("embedding/indptr", np.arange(rows + 1, dtype="i4"))
        file.start_frames(len(HEIGHTS), rows, {"surface": rows})
        for index, height in enumerate(HEIGHTS):
            points = ball.vertices * [1, 1, min(1, height / 0.1)] + [0, 0, height]
            energies = dict(kinetic=KINETIC[index], elastic=ELASTIC[index], potential=height)
            place = dict(time=index / 10, position=points, surface=points)
            file.append(Frame(index=index, **place, **energies))
    return path
