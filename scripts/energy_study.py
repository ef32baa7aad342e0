#!/usr/bin/env python3
"""Energy that shipped scenes gain from nowhere.

    scripts/energy_study.py [SCENE ...] [--set KEY=VALUE ...] [-o PAGE]

Of each run, over the most kinetic and elastic energy that the body had: the greatest rise of kinetic + elastic +
contact's + potential energy from the frames of the file, and what the run's own energy budget
counts (frames/energy_gained). Anchors and obstacles that move do work, so that there the first is no gain.
"""

import lab

import numpy as np

SCENES = sorted(path.stem for path in lab.SCENES.glob("*.toml"))
PARTS = "kinetic", "elastic", "contact", "potential"
WORK = "[[anchor]]", "path = ", "[[force]]", "anchor = ", "[[body.anchor]]"  # what does work on the body, in a scene


def row(scene: str, changes: list[str]) -> lab.Row:
    """Run a scene; its row."""
    run = lab.run(scene, lab.OUT / "energy_study" / f"{scene}.h5", ["--quiet"], ["output.surface=false", *changes])
    frames = run.frames(*PARTS, "energy_gained", start=0)
    total = sum(frames[name] for name in PARTS)
    had = float((frames["kinetic"] + frames["elastic"]).max())
    rise = float((total - np.minimum.accumulate(total)).max())
    gained = max(float(np.nansum(frames["energy_gained"])), 0.0)
    works = any(word in (lab.SCENES / f"{scene}.toml").read_text() for word in WORK)
    return {
        "scene": scene,
        "most kinetic and elastic [J]": had,
        "rise of all energy": "work is done" if works else f"{rise / had:.2%}",
        "from nowhere": f"{gained / had:.2%}",
    }


def main() -> None:
    options = lab.parser(__doc__)
    options.add_argument("scenes", nargs="*", default=SCENES, metavar="SCENE")
    options.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="changes of every scene")
    args = options.parse_args()
    with lab.page(args):
        lab.table(row(scene, args.set) for scene in args.scenes)


if __name__ == "__main__":
    main()
