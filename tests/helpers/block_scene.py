"""A block of a few cells: as a scene file for the command line, and stepped in this process."""

from pathlib import Path

import numpy as np
import tomli_w
import trimesh
from mpi4py import MPI

from msmpetsc.build import Model, build_model
from msmpetsc.fields import Frame
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.simulate import TimeLoop

# cell size [m]: a binary fraction, so that the block is a whole number of cells long
CELL = 1 / 8
SIDES = np.array([0.5, 0.5, 0.25])
YOUNG, DENSITY, G = 1e5, 1000.0, 9.81
GRAVITY = {"acceleration": [0, 0, -G]}
GROUND = {"shape": "plane", "point": [0, 0, 0], "normal": [0, 0, 1], "response": "penalty"}
ROUGH_GROUND = GROUND | {"friction": 0.5}
# stiffness of an edge inside the block (lattice.material)
STIFFEST = 4 / 7 * YOUNG * CELL
# how far a region reaches into a block to hold the nodes on a face [m]
EPS = 1e-3


def half_space(axis: int, at: float = EPS, normal: int = -1) -> dict:
    """The half space beyond ``at`` along an axis."""
    point, along = np.zeros((2, 3))
    point[axis], along[axis] = at, normal
    return {"half_space": {"point": point.tolist(), "normal": along.tolist()}}


def roller(axis: int, at: float = EPS, normal: int = -1) -> dict:
    return {"region": half_space(axis, at, normal), "fix": ["xyz"[axis]]}


CLAMP = {"region": half_space(0)}


def block_scene(folder: Path, sides: np.ndarray = SIDES, name: str = "scene", **tables) -> Path:
    """A scene file of a block with a corner at the origin; ``tables`` are added to it, or take a
    table's place.

    A material without a law is of springs.
    """
    trimesh.creation.box(bounds=[[0, 0, 0], sides]).export(folder / f"{name}.ply")
    scene = {
        "mesh": {"source": f"{name}.ply"},
        "cages": {"cell_size": CELL},
        "material": {"young_modulus": YOUNG, "density": DENSITY},
        "solver": {"preset": "newton", "error": 1e-9},
        "output": {"surface": False},
    }
    scene |= tables
    scene["material"] = {"law": "linear"} | scene["material"]
    path = folder / f"{name}.toml"
    path.write_text(tomli_w.dumps(scene))
    return path


def clamped_beam(folder: Path, **tables) -> Path:
    """A beam of 1 m and 32 cells, clamped at x = 0, that swings under its weight."""
    swings = {"pin": [CLAMP], "gravity": GRAVITY}
    return block_scene(folder, np.array([1.0, 0.25, 0.25]), **swings | tables)


def play(path: Path, *overrides: str) -> tuple[Model, list[Frame]]:
    """Return the model and the frames of a scene on a single rank."""
    scene = load_scene(path, overrides)
    model = build_model(MPI.COMM_SELF, scene)
    with TimeLoop(MPI.COMM_SELF, scene, model) as simulation:
        return model, list(simulation.frames())
