#!/usr/bin/env python3
"""Compare the error that time.error estimates with the true error of the motion.

    scripts/time_error_study.py

The reference is the same scene by BDF2 in equal steps, a 64th of the scene's step (bunny: a 16th,
heart: a 256th). Both errors are relative: the estimate to the largest displacement so far, the true
error to the mean displacement (study.metrics.trajectory_error).
"""

from pathlib import Path
from typing import Any

import lab

import tomli_w

from msmpetsc.scene.reading import load_scene
from msmpetsc.study.metrics import trajectory_error

FOLDER = lab.OUT / "time_error"
BAR, CUBE, PLATE = (1.0, 0.25, 0.25), (0.5, 0.5, 0.5), (1.0, 1.0, 0.125)
HELD: dict[str, Any] = {
    "pin": [{"region": {"half_space": {"point": [0.01, 0, 0], "normal": [-1, 0, 0]}}}]
}
SWINGS = HELD | {"gravity": {"acceleration": [0, 0, -9.81]}}
RAMP = {"times": [0, 0.3, 0.6], "values": [[0, 0, 0], [0, 0, 100], [0, 0, 0]]}
TIP = {"half_space": {"point": [0.99, 0, 0], "normal": [1, 0, 0]}}
# name -> sides [m], duration [s], tables; cells of 1/8 m
BOXES: dict[str, tuple[tuple[float, ...], float, dict[str, Any]]] = {
    "bar of 2 cells, let go twisted by 120 degrees": (
        BAR, 0.5, {"start": {"twist": {"axis": [1, 0, 0], "degrees": 120}}},
    ),
    "bar of 2 cells, let go stretched by 30%": (BAR, 0.5, {"start": {"scale": [1.3, 1, 1]}}),
    "cube of 4 cells, let go pressed by 40%": (CUBE, 0.3, {"start": {"scale": [1, 1, 0.6]}}),
    "bar of 2 cells, clamped, swings": (BAR, 0.96, SWINGS),
    "plate of 1 cell, clamped, swings": (PLATE, 0.9, SWINGS),
    "bar of 2 cells, clamped, pulled slowly": (
        BAR, 0.6, HELD | {"force": [{"region": TIP, "total": RAMP}]},
    ),
    "bar of 2 cells, spins": (BAR, 0.5, {"start": {"spin": [0, 0, 6.0]}}),
}  # fmt: skip
# name -> scene, duration [s]
SHIPPED = {
    "bunny of 1,000 cells, falls and leaps": ("bunny_fall", 0.25),
    "heart of 1,000 cells, pulled and let go": ("heart_pull", 0.9),
}
ERRORS = (0.1, 0.03, 0.01)
# equal steps of the reference in a step of the scene
PARTS, PARTS_OF = 64, {"bunny_fall": 16, "heart_pull": 256}


def box_scene(name: str) -> Path:
    """Write the scene of a box and return its path."""
    sides, duration, tables = BOXES[name]
    stem = f"box{list(BOXES).index(name)}"
    lab.box(FOLDER / f"{stem}.ply", sides)
    scene = {
        "mesh": {"source": f"{stem}.ply"},
        "cages": {"cell_size": 0.125},
        "material": {
            "law": "neo-hookean", "young_modulus": 1e5, "poisson_ratio": 0.3, "density": 1e3,
        },
        "time": {"step": 0.01, "duration": duration},
        "solver": {"preset": "newton", "error": 1e-5},
        "output": {"surface": False},
    } | tables  # fmt: skip
    path = FOLDER / f"{stem}.toml"
    path.write_text(tomli_w.dumps(scene))
    return path


def rows() -> lab.Rows:
    """Yield the estimates and true errors of each scene."""
    for name in (*BOXES, *SHIPPED):
        if name in BOXES:
            scene: Path | str = box_scene(name)
            parts, changes = PARTS, []
        else:
            scene, duration = SHIPPED[name]
            parts = PARTS_OF[scene]
            changes = [
                "cages.count=1000", 'material.law="neo-hookean"', f"time.duration={duration}",
                "output.every=1", "output.surface=false", "solver.error=1e-5",
            ]  # fmt: skip
        file = lab.file_of(scene)
        stem, step = file.stem, load_scene(file).time.step
        truth = FOLDER / f"{stem}_truth.h5"
        if not truth.exists():
            fine = [f"time.step={step / parts!r}", f"output.every={parts}"]
            changed = [change for change in changes if "output.every" not in change]
            lab.run(scene, truth, changes=[*changed, 'time.integrator="bdf2"', *fine])
        row: dict[str, object] = {"scene": name}
        for error in ERRORS:
            chosen = ['time.integrator="bdf2"', f"time.error={error}"]
            run = lab.run(scene, FOLDER / f"{stem}.h5", changes=[*changes, *chosen])
            frames = run.frames("steps", "time_error")
            estimate, true = float(frames["time_error"][-1]), trajectory_error(run.path, truth)
            row[f"asked {error:g}: steps"] = int(frames["steps"].sum())
            row |= {f"{error:g}: estimate": estimate, f"{error:g}: true": true}
            row[f"{error:g}: ratio"] = estimate / true
        yield row


def main() -> None:
    """Print the table."""
    lab.parser(__doc__).parse_args()
    lab.heading()
    lab.table(rows())


if __name__ == "__main__":
    main()
