"""Runs of the neo-Hookean solid: cantilevers, bodies that the grid cuts, starts far from rest."""

import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import lab

import manifold3d
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from small_strain import SPRINGS, law_of

import msmpetsc
from msmpetsc.fields import Frame
from msmpetsc.geometry.prepare import prepare
from msmpetsc.geometry.registry import load
from msmpetsc.lattice.lattice import Lattice

# [Pa], [kg/m^3], [m/s^2]
E, DENSITY, G = 1e6, 1000.0, 9.81
POISSON = (0.25, 0.45, 0.49, 0.4999)
Tables = dict[str, Any]


class Run(NamedTuple):
    """The lattice and the frames of a run."""

    lattice: Lattice
    frames: list[Frame]

    @property
    def iterations(self) -> int:
        """Number of iterations, the sum over all frames."""
        return sum(frame.iterations for frame in self.frames)

    def moved(self, x: float, axis: int = 0) -> np.ndarray:
        """Return the mean displacement (3,) [m], weighted by mass, of the nodes at a coordinate."""
        rest = self.lattice.nodes
        at = np.isclose(rest[:, axis], x)
        return np.average(
            (self.frames[-1].position - rest)[at], axis=0, weights=self.lattice.mass[at]
        )


def run(mesh: trimesh.Trimesh, poisson: float | None, **tables: Any) -> Run:
    """Run a scene of a mesh; without other ``tables`` it is a static equilibrium.

    poisson : Poisson's ratio of a neo-Hookean solid, or SPRINGS
    """
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "body.obj"
        mesh.export(source, digits=17)
        scene: dict[str, Any] = {
            "mesh": {"source": str(source)},
            "time": {"integrator": "static"},
            **tables,
        }
        scene["material"] = (
            {"young_modulus": E, "density": DENSITY} | law_of(poisson) | scene.get("material", {})
        )
        scene = {"solver": {"error": 1e-6}, "output": {"surface": False}} | scene
        simulation = msmpetsc.Simulation(msmpetsc.Scene.of(scene))
        frames = list(simulation.frames())
    assert simulation.model is not None
    return Run(simulation.model.lattice, frames)


def box(*sides: float) -> trimesh.Trimesh:
    """Return a box with a corner at the origin."""
    return trimesh.creation.box(bounds=[[0, 0, 0], sides])


def held(axis: int, at: float, side: int) -> Tables:
    """Return the table of a half space below (-1) or above (1) a plane normal to an axis."""
    normal = side * np.eye(3)[axis]
    return {
        "region": {
            "half_space": {"point": [*(at * np.eye(3)[axis] - 1e-6 * normal)], "normal": [*normal]}
        }
    }


# ---- beams


def bent(length: int, across: int, poisson: float | None, load: float) -> Run:
    """Run a cantilever of thickness 1 m with a transverse load [N] at its end."""
    force = held(0, length, 1) | {"total": [0, 0, -load]}
    return run(
        box(length, 1, 1),
        poisson,
        cages={"cell_size": 1 / across},
        pin=[held(0, 0, -1)],
        force=[force],
    )


# length [m], tip displacement down and back in lengths; Bisshopp and Drucker (1945)
LENGTH, DOWN, BACK = 20, 0.71379, 0.38763


def elastica(across: int, poisson: float | None) -> Run:
    """Run a cantilever with P L^2 / (E I) = 5."""
    return bent(LENGTH, across, poisson, 5 * E / 12 / LENGTH**2)


# Energy [J] of a square bar six sides long, by the angle [degrees] between its ends, at
# Poisson's ratio 0.25. From quadratic hexahedra of the same law, 2 and 4 across,
# extrapolated with order 4, which changes it by 0.1%
TURNED = {30: 1292.4, 90: 11632.0, 180: 46522.0}


def turned_errors(across: int) -> dict[int, float]:
    """Return the error of the energy of a bar at each angle [degrees]."""
    angles = range(15, 181, 15)
    path = [{"time": k, "turn": [angle, 0, 0]} for k, angle in enumerate(angles, 1)]
    frames = run(
        box(6, 1, 1),
        0.25,
        cages={"cell_size": 1 / across},
        pin=[held(0, 0, -1)],
        anchor=[held(0, 6, 1) | {"path": path}],
        time={"integrator": "static", "step": 1.0, "duration": len(path)},
        gravity={"acceleration": [0, 0, 0]},
    ).frames
    return {at: frames[at // 15].elastic / exact - 1 for at, exact in TURNED.items()}


# ---- a body cut by the grid

# height of the cut, relative to the bunny's height
CUT = 0.44


def bunny() -> trimesh.Trimesh:
    """Return the upper part of the bunny, cut at z = 0."""
    whole = prepare(load("bunny", lab.SCENES), [{"simplify": 4000}])
    low, high = whole.points[:, 2].min(), whole.points[:, 2].max()
    base = low + CUT * (high - low)
    solid = manifold3d.Manifold(
        manifold3d.Mesh(whole.points.astype("f4"), whole.triangles.astype("u4"))
    )
    cut = solid.trim_by_plane((0, 0, 1), base).simplify(1e-4).to_mesh()
    surface = trimesh.Trimesh(
        cut.vert_properties[:, :3] - np.array([0, 0, base]), cut.tri_verts, process=False
    )
    surface.vertices[np.abs(surface.vertices[:, 2]) < 1e-6, 2] = 0
    return surface


# ---- a clamp oblique to the grid

# [Pa], so that displacements are small
STIFF = 1e9
# radius of a round bar, and its length beyond the clamp [m]
RADIUS, FREE = 0.05, 0.3
TILT = Rotation.from_rotvec([0, 0, 0.35]) * Rotation.from_rotvec([0, 0.35, 0])


def compliance(cells: int, tilt: Rotation, held: float, poisson: float | None = SPRINGS) -> float:
    """Return the work [J] of a bar's weight, by cells per radius and clamped length in radii."""
    length = FREE + held * RADIUS
    mesh = trimesh.creation.cylinder(RADIUS, length, sections=256)
    mesh.vertices = tilt.apply(mesh.vertices[:, [2, 0, 1]] + [length / 2 - held * RADIUS, 0, 0])
    clamp = {"region": {"half_space": {"point": [0, 0, 0], "normal": [*tilt.apply([-1, 0, 0])]}}}
    tables = {"material": {"young_modulus": STIFF}, "solver": {"error": 1e-5}, "pin": [clamp]}
    gravity = {"acceleration": [*(G * tilt.apply([0, 0, -1]))]}
    bar = run(mesh, poisson, cages={"cell_size": RADIUS / cells}, gravity=gravity, **tables)
    return bar.frames[0].potential - bar.frames[-1].potential


def limit(coarse: int, fine: int, poisson: float | None = SPRINGS) -> float:
    """Return the work [J] for a bar along the grid, extrapolated to cell size 0 (Richardson)."""
    a, b = (compliance(cells, Rotation.identity(), 0.0, poisson) for cells in (coarse, fine))
    return b + (b - a) / ((fine / coarse) ** 2 - 1)


def clamp_errors(
    sizes: tuple[int, ...], exact: float, held: float, poisson: float | None = SPRINGS
) -> np.ndarray:
    """Return the relative error of the stiffness for each number of cells per radius."""
    return exact / np.array([compliance(cells, TILT, held, poisson) for cells in sizes]) - 1


STARTS: dict[str, Tables] = {
    "twisted by 720 degrees": {"twist": {"axis": [1, 0, 0], "degrees": 720}},
    "pressed to 30%": {"scale": [0.3, 1, 1]},
    "mirrored": {"scale": [-1, 1, 1]},
    "scattered": {"scatter": 1.0},
    "collapsed": {"scale": [0.01, 0.01, 0.01]},
}
