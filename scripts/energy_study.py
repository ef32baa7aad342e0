#!/usr/bin/env python3
"""Energy that shipped scenes gain from nowhere: prints a Markdown table.

    scripts/energy_study.py [SCENE ...] [--set KEY=VALUE ...]

Of each run, over the most kinetic and elastic energy that the body had: the greatest rise of kinetic + elastic +
contact's + potential energy from the frames of the file, and what the run's own ledger counts (frames/energy_gained).
Anchors and obstacles that move do work, so that there the first is no gain.
"""

import sys
import tempfile
from pathlib import Path

from clone import ROOT, parser

import numpy as np

import msmpetsc

SCENES = sorted(path.stem for path in (ROOT / "scenes").glob("*.toml"))
PARTS = "kinetic", "elastic", "contact", "potential"


def figures(path: Path) -> tuple[float, float, float]:
    """The most that the body had [J], the greatest rise of all energy [J], and what came from nowhere [J]."""
    with msmpetsc.open(path) as run:
        parts = {name: np.asarray(getattr(run.frames, name)[:]) for name in PARTS}
        gained = np.nansum(run.frames.energy_gained[:])
    total = sum(parts.values())
    rise = (total - np.minimum.accumulate(total)).max()
    return float((parts["kinetic"] + parts["elastic"]).max()), float(rise), max(float(gained), 0.0)


def is_led(scene: Path) -> bool:
    """Whether anything in the scene does work on the body: an anchor, a path, a force."""
    text = scene.read_text()
    return any(word in text for word in ("[[anchor]]", "path = ", "[[force]]", "anchor = ", "[[body.anchor]]"))


def main() -> int:
    options = parser(__doc__)
    options.add_argument("scenes", nargs="*", default=SCENES, metavar="SCENE")
    options.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="changes of every scene")
    args = options.parse_args()
    print("| scene | most kinetic and elastic [J] | rise of all energy | from nowhere |\n|---|---|---|---|")
    for name in args.scenes:
        scene = ROOT / "scenes" / f"{name}.toml"
        with tempfile.TemporaryDirectory() as folder:
            output = msmpetsc.run(scene, Path(folder) / "run.h5", set=["output.surface=false", *args.set], quiet=True)
            had, rise, gained = figures(output)
        told = "work is done" if is_led(scene) else f"{rise / had:.2%}"
        print(f"| {name} | {had:.3g} | {told} | {gained / had:.2%} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
