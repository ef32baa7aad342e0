#!/usr/bin/env python3
"""The paper's Table 1 beside ours: prints Markdown and leaves out/table1.csv. Needs the meshes.

    scripts/table1.py [--frames N] [--results FOLDER]

Runs every scene of the paper on one core, N steps of it or all, or takes the results NAME.h5 of a folder. Frames a
second are those of the steps alone, as each frame's wall_time has them: the mean over the run, and the slowest tenth
of the frames. The error is the largest relative error of a step that the run reports.
"""

import csv
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from clone import ROOT, parser

import numpy as np

from msmpetsc.output.reader import Result

# vertices, facets, valid cells, springs, frames a second on the CPU and on the GPU
PAPER = {
    "armadillo": (12602, 25200, 8338, 164343, 8.1, 30.0),
    "dragon": (23620, 47140, 11536, 232240, 5.5, 23.9),
    "lung": (43040, 86085, 6499, 127843, 10.1, 29.5),
    "heart": (43594, 108357, 3126, 62465, 19.9, 53.4),
    "bunny": (20667, 41330, 9946, 193589, 7.3, 30.1),
    "brain": (55024, 110047, 13661, 264481, 5.1, 20.0),
}
SCENES = (
    "armadillo_leg",
    "armadillo_palm",
    "armadillo_forehead",
    "dragon_raise_push",
    "lung_press",
    "heart_pull",
    "bunny_fall",
    "brain_fall",
)
COLUMNS = ("vertices", "facets", "valid cells", "springs", "springs a cell")
SPEEDS = ("frames a second", "in the slowest tenth", "step error")


def run(scene: str, folder: Path, frames: int | None) -> Path:
    """Simulate a scene; the path of its result."""
    path = folder / f"{scene}.h5"
    steps = [] if frames is None else ["--frames", str(frames)]
    command = [sys.executable, "-m", "msmpetsc", "run", str(ROOT / "scenes" / f"{scene}.toml")]
    subprocess.run([*command, "-o", str(path), "--overwrite", *steps], check=True)
    return path


def figures(path: Path) -> dict[str, float]:
    """Our columns of a result."""
    with Result(path) as result:
        counts = [
            len(result[name]) for name in ("surface/points", "surface/triangles", "lattice/cells", "lattice/springs")
        ]
        wall_time, error = result.frames.wall_time[1:], result.frames.step_error[1:]
    slowest = np.sort(wall_time)[-max(1, len(wall_time) // 10) :]
    values = *counts, counts[3] / counts[2], 1 / wall_time.mean(), 1 / slowest.mean(), error.max()
    return dict(zip((*COLUMNS, *SPEEDS), values, strict=True))


def rows(results: dict[str, Path]) -> Iterator[dict]:
    """A scene's figures, ours and the paper's, by column."""
    for scene, path in results.items():
        vertices, facets, cells, springs, cpu, gpu = PAPER[scene.split("_")[0]]
        paper = dict(zip(COLUMNS, (vertices, facets, cells, springs, springs / cells), strict=True))
        paper |= {"frames a second": cpu, "on a GPU": gpu}
        ours = figures(path)
        yield (
            {"scene": scene} | {name: ours[name] for name in ours} | {f"paper: {name}": x for name, x in paper.items()}
        )


def shown(x: float | str | int) -> str:
    if isinstance(x, float):
        return f"{x:.3g}"
    return f"{x:,}" if isinstance(x, int) else x


def print_markdown(table: list[dict]) -> None:
    """Ours, and the paper's in brackets."""
    print("\n| scene (the paper's figures in brackets) |", " | ".join((*COLUMNS, *SPEEDS)), "|")
    print("|---" * (1 + len(COLUMNS) + len(SPEEDS)) + "|")
    for row in table:
        cells = [
            shown(row[name]) + (f" ({shown(row[f'paper: {name}'])})" if f"paper: {name}" in row else "")
            for name in (*COLUMNS, *SPEEDS)
        ]
        print("|", row["scene"], "|", " | ".join(cells), "|")


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--frames", type=int, metavar="N", help="steps of each scene; all of them if absent")
    options.add_argument("--results", type=Path, metavar="FOLDER", help="take the results NAME.h5 of this folder")
    args = options.parse_args()
    folder = ROOT / "out"
    if args.results:
        results = {scene: args.results / f"{scene}.h5" for scene in SCENES}
    else:
        results = {scene: run(scene, folder / "table1", args.frames) for scene in SCENES}
    table = list(rows(results))
    folder.mkdir(exist_ok=True)
    with open(folder / "table1.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, table[0])
        writer.writeheader()
        writer.writerows(table)
    print_markdown(table)


if __name__ == "__main__":
    main()
