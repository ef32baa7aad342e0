#!/usr/bin/env python3
"""Times what a frame of the bunny spends on things that are not its solution, and prints a Markdown table. Needs the
meshes.

    scripts/frame_study.py [--frames N] [--repeats N] [--set KEY=VALUE ...]     the first 60 frames, five times

The bunny falls freely there, so a frame is as cheap as it can be and each of these as large a share of it as it can
be. Times are those within the functions named, the least of the repeats; each repeat is a run of its own.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import wraps
from time import perf_counter
from typing import Any

from clone import ROOT, parser

from msmpetsc.app.observers import FrameWriter
from msmpetsc.cli.main import main as msmpetsc
from msmpetsc.output.writer import ResultFile
from msmpetsc.solve.energy_balance import EnergyBalance
from msmpetsc.solve.linear.surface import SurfaceMotion
from msmpetsc.solve.monitors import Monitors
from msmpetsc.solve.nonlinear.curvature import LowestCurvature
from msmpetsc.solve.nonlinear.first_guess import FirstGuess
from msmpetsc.solve.simulate import Simulation

FRAME = {
    "step": (Simulation, "_advance"),
    "stored": (FrameWriter, "after_step"),
}
PARTS = {
    "surface of the frame": (SurfaceMotion, "__call__"),
    "frame written": (ResultFile, "append"),
    "of it, its positions and surface": (ResultFile, "_collect"),
    "first guesses compared": (FirstGuess, "best"),
    "bound on negative curvature": (LowestCurvature, "compression"),
    "energies, and their balance": (EnergyBalance, "examine"),
    "cells inside out counted": (Monitors, "inverted"),
    "obstacles that are new": (Monitors, "overlaps"),
}


def timed(seconds: dict[str, float], name: str, function: Callable) -> Callable:
    """Return the function, with the time within it added to ``seconds`` under a name."""

    @wraps(function)
    def call(*arguments: Any, **more: Any) -> Any:
        begin = perf_counter()
        try:
            return function(*arguments, **more)
        finally:
            seconds[name] += perf_counter() - begin

    return call


def measure(frames: int, changes: Sequence[str]) -> None:
    """Run the scene's first frames in this process, and print each part's milliseconds a frame, a line each."""
    parts = FRAME | PARTS
    seconds = dict.fromkeys(parts, 0.0)
    for name, (kind, method) in parts.items():
        setattr(kind, method, timed(seconds, name, getattr(kind, method)))
    out = ROOT / "out" / "frame_study.h5"
    words = ["run", ROOT / "scenes/bunny_fall.toml", "-o", out, "--overwrite", "--frames", frames]
    msmpetsc([str(word) for word in (*words, *(word for change in changes for word in ("--set", change)))])
    for name, total in seconds.items():
        print(f"{name}\t{1e3 * total / frames}")


def measured() -> dict[str, float]:
    """Return the same of a run in a process of its own."""
    command = [sys.executable, *sys.argv, "--repeats", "0"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    lines = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout.splitlines()
    return {name: float(value) for name, _, value in (line.partition("\t") for line in lines if "\t" in line)}


def main() -> None:
    """Print the table."""
    reader = parser(__doc__)
    reader.add_argument("--frames", type=int, default=60)
    reader.add_argument("--repeats", type=int, default=5, help="0 for one run in this process, and bare figures")
    reader.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of the scene")
    arguments = reader.parse_args()
    if not arguments.repeats:
        return measure(arguments.frames, arguments.set)
    runs = [measured() for _ in range(arguments.repeats)]
    whole = min(sum(run[name] for name in FRAME) for run in runs)
    print("| part | ms | share |\n|---|---|---|")
    print(f"| a frame | {whole:.2f} | |")
    for name in PARTS:
        least = min(run[name] for run in runs)
        print(f"| {name} | {least:.2f} | {100 * least / whole:.1f}% |")


if __name__ == "__main__":
    main()
