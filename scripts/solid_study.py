#!/usr/bin/env python3
"""Compare the neo-Hookean solid with theory and finite elements. Needs scikit-fem.

    scripts/solid_study.py [cantilever elastica rod ...]

All tables are from runs of the program; errors are relative.
"""

import os
import tempfile
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import lab
from lab import percent

import manifold3d
import numpy as np
import skfem
import trimesh
from material_study import LAWS, SPRINGS
from scipy.spatial.transform import Rotation
from skfem.models.elasticity import lame_parameters, linear_elasticity

import msmpetsc
from msmpetsc.elasticity.cell_volume import least_volumes
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.fields import Frame
from msmpetsc.geometry.prepare import prepare
from msmpetsc.geometry.registry import load
from msmpetsc.lattice.lattice import Lattice

# [Pa], [kg/m^3], [m/s^2]
E, DENSITY, G = 1e6, 1000.0, 9.81
POISSON = (0.25, 0.45, 0.49, 0.4999)
Tables = dict[str, Any]


class Run(NamedTuple):
    """A run's lattice, its surface at rest (v, 3) [m] or None, and its frames."""

    lattice: Lattice
    surface: np.ndarray | None
    frames: list[Frame]

    @property
    def iterations(self) -> int:
        """Sum of the iterations of all frames."""
        return sum(frame.iterations for frame in self.frames)

    def moved(self, x: float, axis: int = 0) -> np.ndarray:
        """Return the mean displacement (3,) [m], weighted by mass, of nodes with a coordinate."""
        rest = self.lattice.nodes
        at = np.isclose(rest[:, axis], x)
        return np.average(
            (self.frames[-1].position - rest)[at], axis=0, weights=self.lattice.mass[at]
        )


def run(mesh: trimesh.Trimesh | Path, poisson: float | None, **tables: Any) -> Run:
    """Run a scene of a mesh; without other ``tables`` it is a static equilibrium.

    poisson : Poisson's ratio of a neo-Hookean solid, or SPRINGS
    """
    law = (
        {"law": "linear"}
        if poisson is SPRINGS
        else {"law": "neo-hookean", "poisson_ratio": poisson}
    )
    with tempfile.TemporaryDirectory() as folder:
        source = mesh
        if isinstance(mesh, trimesh.Trimesh):
            source = Path(folder) / "body.obj"
            mesh.export(source, digits=17)
        scene: dict[str, Any] = {
            "mesh": {"source": str(source)},
            "time": {"integrator": "static"},
            **tables,
        }
        scene["material"] = (
            {"young_modulus": E, "density": DENSITY} | law | scene.get("material", {})
        )
        scene = {"solver": {"error": 1e-6}, "output": {"surface": False}} | scene
        simulation = msmpetsc.Simulation(msmpetsc.Scene.of(scene))
        frames = list(simulation.frames())
    assert simulation.model is not None
    surface = simulation.model.surface
    return Run(simulation.model.lattice, None if surface is None else surface.points, frames)


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


def sag_error(across: int, poisson: float | None, length: int = 10) -> float:
    """Return the error of a cantilever's tip deflection under a small load.

    The reference is Timoshenko's beam with Cowper's (1966) shear coefficient.
    """
    nu = 0.25 if poisson is SPRINGS else poisson
    load = 1e-5 * E
    kappa = 10 * (1 + nu) / (12 + 11 * nu)
    exact = load * (length**3 / (3 * E / 12) + length * 2 * (1 + nu) / (kappa * E))
    return -bent(length, across, poisson, load).moved(length)[2] / exact - 1


def cantilever_rows() -> lab.Rows:
    """Yield the errors of the tip deflection for each Poisson's ratio."""
    for poisson in (SPRINGS, *POISSON):
        errors = {f"{across} cells": percent(sag_error(across, poisson), 2) for across in (2, 4)}
        yield {"Poisson's ratio": str(poisson or "springs")} | errors


# length [m], tip displacement down and back in lengths; Bisshopp and Drucker (1945)
LENGTH, DOWN, BACK = 20, 0.71379, 0.38763


def elastica(across: int, poisson: float | None) -> Run:
    """Run a cantilever with P L^2 / (E I) = 5."""
    return bent(LENGTH, across, poisson, 5 * E / 12 / LENGTH**2)


def elastica_rows() -> lab.Rows:
    """Yield the errors of the tip's displacement for each Poisson's ratio and cell size."""
    for poisson in (SPRINGS, 0.25, 0.45, 0.49, 0.4999):
        for across in (2, 4):
            bar = elastica(across, poisson)
            back, _, down = -bar.moved(LENGTH) / LENGTH
            yield {
                "Poisson's ratio": str(poisson or "springs"),
                "cells across": across,
                "tip down": percent(down / DOWN - 1, 2),
                "tip back": percent(back / BACK - 1, 2),
                "tip off, of the length": percent(np.hypot(down - DOWN, back - BACK), 2),
                "Newton iterations": bar.iterations,
            }


# ---- bodies cut by the grid


def tetrahedra(surface: trimesh.Trimesh) -> skfem.MeshTet:
    """Return a tetrahedral mesh of the inside, whose first points are the surface's points."""
    # not in an extra, because its licence is AGPL
    import tetgen

    mesh = tetgen.TetGen(np.asarray(surface.vertices), np.asarray(surface.faces))
    points, cells = mesh.tetrahedralize(order=1, nobisect=True, minratio=1.4, mindihedral=10)[:2]
    assert np.allclose(points[: len(surface.vertices)], surface.vertices)
    return skfem.MeshTet(points.T.copy(), cells.T.copy())


def fem_surface(
    surface: trimesh.Trimesh, young: float, poisson: float, load: np.ndarray
) -> np.ndarray:
    """Return the linear displacement (v, 3) [m] from quadratic tetrahedra, clamped at z = 0.

    load : force density (3,) [N/m^3]
    """
    basis = skfem.Basis(tetrahedra(surface), skfem.ElementVector(skfem.ElementTetP2()))
    K = linear_elasticity(*lame_parameters(young, poisson)).assemble(basis)
    f = skfem.LinearForm(lambda v, _: load[0] * v[0] + load[1] * v[1] + load[2] * v[2]).assemble(
        basis
    )
    fixed = basis.get_dofs(
        basis.mesh.facets_satisfying(lambda x: x[2] < 1e-9, boundaries_only=True)
    )
    u = skfem.solve(*skfem.condense(K, f, D=fixed), solver=skfem.solver_iter_pcg(rtol=1e-10))
    return u[basis.nodal_dofs[:, : len(surface.vertices)]].T


# [Pa], [m/s^2]; small displacements
SCAN_E, PUSH = 1e9, [9.81, 0.0, 0.0]
# height of the cut, relative to the bunny's height
CUT = 0.44


def scan_rows(surface: Any, exact: np.ndarray) -> lab.Rows:
    """Yield the relative L2 errors of the surface displacement; ``exact`` is (v, 3) [m]."""
    area = np.bincount(surface.faces.ravel(), np.repeat(surface.area_faces / 3, 3))
    size = area @ (exact**2).sum(axis=1)
    for count in (1000, 10_000):
        row: dict[str, object] = {"cells asked": count}
        for name, poisson in (("springs", SPRINGS), ("neo-Hookean", 0.25)):
            tables = {
                "material": {"young_modulus": SCAN_E},
                "gravity": {"acceleration": PUSH},
                "output": {},
            }
            scan = run(surface, poisson, cages={"count": count}, pin=[held(2, 0, -1)], **tables)
            assert scan.surface is not None
            u = scan.frames[-1].surface - scan.surface
            error = np.sqrt(area @ ((u - exact) ** 2).sum(axis=1) / size)
            # minimises |factor * exact - u|
            factor = area @ (u * exact).sum(axis=1) / size
            row |= {
                "cells": len(scan.lattice.cells),
                name: percent(error),
                f"{name}, best factor": f"{factor:.3f}",
            }
        yield row


def rod_rows() -> lab.Rows:
    """Yield the rows of the rod and its finite elements in $MSMPETSC_SOLID."""
    folder = Path(os.environ.get("MSMPETSC_SOLID", ""))
    yield from scan_rows(
        trimesh.load(folder / "rod_cut.ply", process=False), np.load(folder / "rod_fem.npz")["U"]
    )


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


def bunny_rows() -> lab.Rows:
    """Yield the rows of the bunny."""
    surface = bunny()
    yield from scan_rows(surface, fem_surface(surface, SCAN_E, 0.25, DENSITY * np.array(PUSH)))


def box_rows() -> lab.Rows:
    """Yield the rows of the beam of studies/beam_soft.toml, upright and along the grid."""
    surface = box(0.5, 0.5, 1.25)
    for _ in range(4):
        surface = surface.subdivide()
    yield from scan_rows(surface, fem_surface(surface, SCAN_E, 0.25, DENSITY * np.array(PUSH)))


# ---- a clamp oblique to the grid

# radius of a round bar, and its length beyond the clamp [m]
RADIUS, FREE = 0.05, 0.3
TILT = Rotation.from_rotvec([0, 0, 0.35]) * Rotation.from_rotvec([0, 0.35, 0])
# length of the clamped part in radii
CLAMPS = {"plane through cells": 1.0, "end face": 0.0}


def compliance(cells: int, tilt: Rotation, held: float, poisson: float | None = SPRINGS) -> float:
    """Return the work [J] of a bar's weight, with cells per radius and held radii clamped."""
    length = FREE + held * RADIUS
    mesh = trimesh.creation.cylinder(RADIUS, length, sections=256)
    mesh.vertices = tilt.apply(mesh.vertices[:, [2, 0, 1]] + [length / 2 - held * RADIUS, 0, 0])
    clamp = {"region": {"half_space": {"point": [0, 0, 0], "normal": [*tilt.apply([-1, 0, 0])]}}}
    tables = {"material": {"young_modulus": SCAN_E}, "solver": {"error": 1e-5}, "pin": [clamp]}
    gravity = {"acceleration": [*(G * tilt.apply([0, 0, -1]))]}
    bar = run(mesh, poisson, cages={"cell_size": RADIUS / cells}, gravity=gravity, **tables)
    return bar.frames[0].potential - bar.frames[-1].potential


def limit(coarse: int, fine: int, poisson: float | None = SPRINGS) -> float:
    """Return the work [J] of a bar along the grid, extrapolated to cell size 0 (Richardson)."""
    a, b = (compliance(cells, Rotation.identity(), 0.0, poisson) for cells in (coarse, fine))
    return b + (b - a) / ((fine / coarse) ** 2 - 1)


def clamp_errors(
    sizes: tuple[int, ...], exact: float, held: float, poisson: float | None = SPRINGS
) -> np.ndarray:
    """Return the relative error of the stiffness for each size in cells per radius."""
    return exact / np.array([compliance(cells, TILT, held, poisson) for cells in sizes]) - 1


def clamp_rows() -> lab.Rows:
    """Yield the errors of a round bar tilted about two axes, under its weight.

    The reference is the work of a bar along the grid.
    """
    # cells per radius
    sizes = (4, 8, 16)
    for law, poisson in LAWS.items():
        exact = limit(*sizes[1:], poisson)
        errors = {name: clamp_errors(sizes, exact, held, poisson) for name, held in CLAMPS.items()}
        for k, cells in enumerate(sizes):
            yield {"law": law, "cells": f"R/{cells}"} | {
                name: percent(values[k], 2) for name, values in errors.items()
            }
        yield {"law": law, "cells": "order"} | {
            name: f"{lab.slope([1 / cells for cells in sizes], values):.2f}"
            for name, values in errors.items()
        }


# ---- compressed blocks, nearly incompressible


# width of the block of height 1 [m], and its compression [m]
WIDE, PRESSED = 2.0, 1e-3


def graded(start: float, stop: float, count: int) -> np.ndarray:
    """Return a grid from ``start`` to ``stop``, refined there for the singularity of the stress."""
    return stop + (start - stop) * np.linspace(1, 0, count + 1) ** 3


def fem_force(poisson: float, half: float) -> float:
    """Return the force [N] on a bonded plate of width 2 ``half``, from quadratic hexahedra.

    The mesh is a quarter of the block.
    """
    x = np.unique(
        np.concatenate([graded(0, half, 4), graded(WIDE / 2, half, 4 if half < WIDE / 2 else 0)])
    )
    z = np.unique(np.concatenate([graded(0.5, 0, 3), graded(0.5, 1, 4)]))
    mesh = skfem.MeshHex.init_tensor(x, x, z)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHex2()), intorder=5)
    K = linear_elasticity(*lame_parameters(E, poisson)).assemble(basis)
    bottom = basis.get_dofs(mesh.facets_satisfying(lambda x: np.isclose(x[2], 0)))
    middles = [
        basis.get_dofs(mesh.facets_satisfying(lambda x, k=k: np.isclose(x[k], 0))).all(f"u^{k + 1}")
        for k in (0, 1)
    ]
    plate = basis.get_dofs(
        mesh.facets_satisfying(lambda x: np.isclose(x[2], 1) & (x[0] < half) & (x[1] < half))
    )
    u = basis.zeros()
    u[plate.all("u^3")] = -PRESSED
    fixed = np.unique(np.concatenate([bottom.all(), plate.all(), *middles]))
    u = skfem.solve(
        *skfem.condense(K, basis.zeros(), x=u, D=fixed), solver=skfem.solver_iter_pcg(rtol=1e-10)
    )
    return -4 * (K @ u)[plate.all("u^3")].sum()


def force(poisson: float | None, half: float, high: int) -> float:
    """Return the force [N] on the plate from a lattice ``high`` cells high."""
    corners = [
        [WIDE / 2 - half, WIDE / 2 - half, 1 - 1e-6],
        [WIDE / 2 + half, WIDE / 2 + half, 1 + 1e-6],
    ]
    anchor = {"region": {"box": corners}, "path": [{"time": 1, "by": [0, 0, -PRESSED]}]}
    tables = {
        "pin": [held(2, 0, -1)],
        "anchor": [anchor],
        "time": {"integrator": "static", "step": 1, "duration": 1},
    }
    block = run(box(WIDE, WIDE, 1), poisson, cages={"cell_size": 1 / high}, **tables)
    gradient = np.zeros_like(block.lattice.nodes)
    Elasticity(block.lattice).add_gradient(block.frames[-1].position, gradient)
    return -gradient[np.isclose(block.lattice.nodes[:, 2], 1), 2].sum()


def pressed_rows(half: float) -> lab.Rows:
    """Yield the errors of the force on a plate for each Poisson's ratio."""
    for poisson in (0.45, 0.49):
        exact = fem_force(poisson, half)
        row = {
            "Poisson's ratio": str(poisson),
            "quadratic FEM [N]": exact,
            "springs, 8 cells": percent(force(SPRINGS, half, 8) / exact - 1),
        }
        yield row | {
            f"{high} cells": percent(force(poisson, half, high) / exact - 1) for high in (4, 8, 16)
        }


STARTS: dict[str, Tables] = {
    "twisted by 720 degrees": {"twist": {"axis": [1, 0, 0], "degrees": 720}},
    "pressed to 30%": {"scale": [0.3, 1, 1]},
    "mirrored": {"scale": [-1, 1, 1]},
    "scattered": {"scatter": 1.0},
    "collapsed": {"scale": [0.01, 0.01, 0.01]},
}
FALL = {"time": {"step": 1 / 20, "duration": 60}, "solver": {"error": 1e-3}}


def start_rows(tables: Tables) -> lab.Rows:
    """Yield the end states of a clamped, unloaded bar of 4 x 1 x 1 m from each start."""
    for across, name in product((2, 3, 4, 6), STARTS):
        ends = {
            f"nu {nu}": came_back(nu, across, tables | {"start": STARTS[name]})
            for nu in (0.25, 0.45, 0.49)
        }
        yield {"cells across": across, "start": name} | ends


def came_back(poisson: float, across: int, tables: Tables) -> str:
    """Return the largest distance from rest [cells], the iterations and the folded cells."""
    bar = run(
        box(4, 1, 1), poisson, cages={"cell_size": 1 / across}, pin=[held(0, 0, -1)], **tables
    )
    last = bar.frames[-1].position
    largest = np.linalg.norm(last - bar.lattice.nodes, axis=1).max() * across
    folded = int((least_volumes(last, bar.lattice.cells) <= 0).sum())
    return f"{largest:.0e}; {bar.iterations}; {folded} folded"


BEAM = lab.SCENES / "studies" / "beam.obj"


def beam(poisson: float | None, h: float, time: Tables, g: float = G, error: float = 1e-6) -> Run:
    """Run the beam of studies/beam_soft.toml with cells of size h [m] under gravity g [m/s^2]."""
    tables = {
        "gravity": {"acceleration": [0, 0, -g]},
        "pin": [held(0, 0, -1)],
        "material": {"young_modulus": 5e5},
    }
    return run(BEAM, poisson, cages={"cell_size": h}, time=time, solver={"error": error}, **tables)


def rest_rows() -> lab.Rows:
    """Yield the rows of the beam in equilibrium, with 16, 32 and 64 cells across its depth."""
    for cells in (16, 32, 64):
        for g, poisson in ((1, 0.25), (2, 0.25), (1, 0.45), (2, 0.45), (1, 0.499), (2, 0.499)):
            bar = beam(poisson, 0.5 / cells, {"integrator": "static"}, g * G)
            yield {
                "g": g,
                "Poisson's ratio": str(poisson),
                "h / depth": f"1/{cells}",
                "cells": len(bar.lattice.cells),
                "tip [m]": f"{-bar.moved(1.25)[2]:.4f}",
                "Newton iterations": bar.iterations,
                "CG": bar.frames[-1].ksp_its,
                "inside out": bar.frames[-1].inverted,
            }


def swing_rows() -> lab.Rows:
    """Yield the rows of the beam released from rest."""
    # as in scenes/studies/beam_soft.toml
    time = {"step": 1 / 60, "duration": 0.5}
    for poisson, sizes in (
        (SPRINGS, (1 / 32,)),
        (0.25, (1 / 32, 1.25 / 87)),
        (0.45, (1 / 32, 1.25 / 87)),
    ):
        for h in sizes:
            bar = beam(poisson, h, time, error=1e-3)
            its = [frame.iterations for frame in bar.frames[1:]]
            tips = [bar._replace(frames=[frame]).moved(1.25)[2] for frame in bar.frames]
            yield {
                "Poisson's ratio": str(poisson or "springs"),
                "cells": len(bar.lattice.cells),
                "Newton iterations a frame: mean": float(np.mean(its)),
                "most": max(its),
                "most cells inside out": max(frame.inverted for frame in bar.frames),
                "tip at the end [m]": f"{-tips[-1]:.4f}",
                "lowest [m]": f"{-min(tips):.4f}",
            }


TABLES: dict[str, Callable[[], lab.Rows]] = {
    "cantilever": cantilever_rows,
    "elastica": elastica_rows,
    "rod": rod_rows,
    "bunny": bunny_rows,
    "box": box_rows,
    "clamp": clamp_rows,
    "pad": lambda: pressed_rows(WIDE / 2),
    "punch": lambda: pressed_rows(WIDE / 4),
    "starts": lambda: start_rows(FALL),
    "statics": lambda: start_rows({}),
    "rest": rest_rows,
    "swing": swing_rows,
}


def main() -> None:
    """Print the tables that the command line names."""
    lab.tables(__doc__, TABLES)


if __name__ == "__main__":
    main()
