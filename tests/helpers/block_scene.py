"""A block of a few cells, as a scene file for the command line or stepped in this process."""

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


def plane_at(height: float = 0.0, up: int = 1, **more) -> dict:
    """Return the table of a plane obstacle across z; ``side`` is -1 if bodies lie below it."""
    return {"shape": "plane", "point": [0, 0, height], "normal": [0, 0, up]} | more


def box_at(bounds: list, **more) -> dict:
    """Return the table of a box obstacle."""
    return {"shape": "box", "box": bounds} | more


def solid_of(young: float, poisson: float | None = None, **more) -> dict:
    """Return the table of a neo-Hookean solid of 1000 kg/m^3."""
    given = {} if poisson is None else {"poisson_ratio": poisson}
    return {"law": "neo-hookean", "young_modulus": young, "density": DENSITY} | given | more


GROUND = plane_at(response="penalty")
ROUGH_GROUND = GROUND | {"friction": 0.5}
# stiffness of an edge inside the block (lattice.material)
STIFFEST = 4 / 7 * YOUNG * CELL
# how far a region reaches into a block in order to hold the nodes on a face [m]
EPS = 1e-3


def half_space(axis: int, at: float = EPS, normal: int = -1) -> dict:
    """Return the half space beyond ``at`` along an axis."""
    point, along = np.zeros((2, 3))
    point[axis], along[axis] = at, normal
    return {"half_space": {"point": point.tolist(), "normal": along.tolist()}}


def roller(axis: int, at: float = EPS, normal: int = -1) -> dict:
    return {"region": half_space(axis, at, normal), "fix": ["xyz"[axis]]}


CLAMP = {"region": half_space(0)}


def write_scene(folder: Path, name: str = "scene", **tables) -> Path:
    """Write these tables to a scene file."""
    path = folder / f"{name}.toml"
    path.write_text(tomli_w.dumps(tables))
    return path


def block_scene(folder: Path, sides: np.ndarray = SIDES, name: str = "scene", **tables) -> Path:
    """Write the scene of a block at the origin; ``tables`` replace or extend its tables.

    A material without a law consists of springs.
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
    return write_scene(folder, name, **scene)


def model_of(path: Path, *changes: str) -> Model:
    """Return the model of a scene on a single rank."""
    return build_model(MPI.COMM_SELF, load_scene(path, changes))


def clamped_beam(folder: Path, **tables) -> Path:
    """Write the scene of a beam of 1 m and 32 cells, clamped at x = 0, that swings."""
    swings = {"pin": [CLAMP], "gravity": GRAVITY}
    return block_scene(folder, np.array([1.0, 0.25, 0.25]), **swings | tables)


def loop_of(path: Path, *changes: str, **more) -> TimeLoop:
    """Return the time loop of a scene on a single rank, before its first step."""
    scene = load_scene(path, changes)
    return TimeLoop(MPI.COMM_SELF, scene, build_model(MPI.COMM_SELF, scene), **more)


def play(path: Path, *changes: str) -> tuple[Model, list[Frame]]:
    """Run a scene on a single rank; return its model and frames."""
    with loop_of(path, *changes) as simulation:
        return simulation.model, list(simulation.frames())
