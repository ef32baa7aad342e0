#!/usr/bin/env python3
"""Presses the lung ever lower with both laws of the springs and prints a Markdown table. Needs the mesh.

    scripts/press_study.py [CELLS]     1000 if not given

inverted: cells with a corner inside out, the most of any frame and at the end. shape error: of the lobes at the end,
after the best rigid motion, in heights of the lung; the first rows, whose plate stays up, say what its weight makes of
it. through: the deepest any point of the surface gets into ground or plate.
"""

import subprocess
import sys
from pathlib import Path

from clone import ROOT, parser

import numpy as np
from scipy.spatial.transform import Rotation

from msmpetsc.model.elasticity.inversion import least_volumes
from msmpetsc.model.loads import Motion
from msmpetsc.output.drawing.subject import read_scene
from msmpetsc.output.reader import Result

SCENE, OUT = ROOT / "scenes" / "lung_press.toml", ROOT / "out" / "press_study"
HEIGHT, START = 0.37, 0.38  # of the lung and of the plate's lower face at the start [m]
SHARES, LAWS = (START / HEIGHT, 0.6, 0.45, 0.3), ("linear", "stiffening")


def press(law: str, share: float, cells: str) -> Path:
    """Run the scene with the plate down to a share of the lung's height; the path of the result."""
    path, by = OUT / f"{law}_{share:.2f}.h5", f"[0, 0, {share * HEIGHT - START:.4f}]"
    options = [f"cages.count={cells}", f"material.law={law}", *(f"obstacle.1.path.{k}.by={by}" for k in (0, 1))]
    changes = [word for option in options for word in ("--set", option)]
    command = [sys.executable, "-m", "msmpetsc", "run", SCENE, "-o", path, "--overwrite", *changes]
    subprocess.run([str(word) for word in command], check=False)  # a run that fails leaves its frames: they count
    return path


def shape_error(rest: np.ndarray, q: np.ndarray, mass: np.ndarray) -> float:
    """Distance of q (n, 3) from rest after the best rigid motion, rms by mass [m]."""
    rest, q = (x - mass @ x / mass.sum() for x in (rest, q))
    _, distance = Rotation.align_vectors(q, rest, weights=mass)
    return distance / np.sqrt(mass.sum())


def row(law: str, share: float, path: Path) -> list[str]:
    with Result(path) as result:
        scene, count, cells = read_scene(result), len(result.frames.time), result.lattice.cells[:]
        nodes, mass, times = result.lattice.nodes[:], result.lattice.mass[:], result.frames.time[:]
        q, iterations = result.frames.position[:], result.frames.iterations[1:]
        height = np.array([result.embedding @ x[:, 2] for x in q])  # of the surface's points [m]
    plate = scene.obstacle[1]
    assert plate.box is not None and plate.stop is not None
    low = np.array([plate.box[0][2] + Motion.through(plate.path).displacement_at(time)[2] for time in times])
    above = (height.max(axis=1) - low)[times < plate.stop - 1e-9].max()
    inverted = [int((least_volumes(x, cells) <= 0).sum()) for x in q]
    body = nodes[:, 2] < HEIGHT / 2
    error = shape_error(nodes[body], q[-1][body], mass[body]) / HEIGHT
    return [
        "stays up" if share == SHARES[0] else f"{100 * share:.0f}%",
        law,
        str(max(inverted)),
        str(inverted[-1]),
        f"{100 * error:.1f}%",
        f"{1000 * max(above, -height.min()):.1f} mm",
        f"{iterations.mean():.1f}" + ("" if count == scene.time.steps + 1 else f", fails at frame {count}"),
    ]


def main() -> None:
    options = parser(__doc__)
    options.add_argument("cells", nargs="?", default="1000", metavar="CELLS", help="cells of the lung (1000)")
    cells = options.parse_args().cells
    rows = [row(law, share, press(law, share, cells)) for share in SHARES for law in LAWS]
    columns = ("plate at", "law", "most inverted", "inverted at the end", "shape error", "through", "iterations a step")
    for cells_of_row in (columns, ["---"] * len(columns), *rows):
        print("|", " | ".join(cells_of_row), "|")


if __name__ == "__main__":
    main()
