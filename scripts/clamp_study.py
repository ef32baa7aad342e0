#!/usr/bin/env python3
"""How a clamp that lies askew in the grid converges: a round bar tilted about two axes, under its weight.

A half space clamps it, either its last radius, the plane going through cells, or its end face alone. What is compared
is the work of the weight, to the limit of a bar along the grid, whose clamp is a plane of nodes.
"""

import tempfile
from pathlib import Path

import lab

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

import msmpetsc

RADIUS, FREE = 0.05, 0.3  # of the bar, and its length beyond the clamp [m]
TILT = Rotation.from_rotvec([0, 0, 0.35]) * Rotation.from_rotvec([0, 0.35, 0])
SIZES = (4, 8, 16)  # cells a radius
CLAMPS = {"plane through cells": 1.0, "end face": 0.0}  # held over so many radii


def compliance(cells: int, tilt: Rotation, held: float) -> float:
    """Work [J] of the weight of a bar that is clamped over so many radii at its end, cells of RADIUS / ``cells``."""
    length = FREE + held * RADIUS
    mesh = trimesh.creation.cylinder(RADIUS, length, sections=256)
    mesh.vertices = tilt.apply(mesh.vertices[:, [2, 0, 1]] + [length / 2 - held * RADIUS, 0, 0])
    with tempfile.TemporaryDirectory() as folder:
        mesh.export(Path(folder) / "bar.ply")
        tables = {
            "mesh": {"source": "bar.ply"},
            "cages": {"cell_size": RADIUS / cells},
            "material": {"young_modulus": 1e9, "density": 1000},
            "time": {"integrator": "static", "step": 1, "duration": 1},
            "solver": {"error": 1e-5},
            "gravity": {"acceleration": [*(9.81 * tilt.apply([0, 0, -1]))]},
            "pin": [{"region": {"half_space": {"point": [0, 0, 0], "normal": [*tilt.apply([-1, 0, 0])]}}}],
        }
        first, *_, last = (frame.potential for frame in msmpetsc.frames(msmpetsc.Scene.of(tables, folder=folder)))
    return first - last


def limit(coarse: int, fine: int) -> float:
    """Work [J] of a bar along the grid in the limit of small cells, by Richardson's extrapolation."""
    a, b = (compliance(cells, Rotation.identity(), 0.0) for cells in (coarse, fine))
    return b + (b - a) / ((fine / coarse) ** 2 - 1)


def errors(sizes: tuple[int, ...], exact: float, held: float) -> np.ndarray:
    """Relative errors of the stiffness, one a size."""
    return exact / np.array([compliance(cells, TILT, held) for cells in sizes]) - 1


def main() -> None:
    args = lab.parser(__doc__).parse_args()
    exact = limit(*SIZES[1:])
    found = {name: errors(SIZES, exact, held) for name, held in CLAMPS.items()}
    names = [f"R/{cells}" for cells in SIZES]
    with lab.page(args):
        lab.table(
            {"cells": of, **{name: lab.percent(found[name][k], 2) for name in CLAMPS}} for k, of in enumerate(names)
        )
        sizes = [1 / cells for cells in SIZES]
        print("\nOrders:", ", ".join(f"{lab.slope(sizes, of):.2f} {name}" for name, of in found.items()))


if __name__ == "__main__":
    main()
