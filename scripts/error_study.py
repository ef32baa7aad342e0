#!/usr/bin/env python3
"""Compare the error estimates of steps with their true errors on random hard scenes.

    scripts/error_study.py [--scenes 500] [--seed 1] [--kinds any rub far touch] [--only K]
        [--set KEY=VALUE ...]

The seed and a number determine a scene. The body has 40 to 150 cells: a beam, cube, plate or ball,
tilted or not, soft or stiff, of either law, in parts with a stiffness ratio of up to 1e6. It starts
squashed, stretched, twisted, scattered, spinning or thrown, or plates press it with friction. It is
pinned, anchored or free; steps are short or long, and presets vary. The script solves each step
again to rounding, from its end. It reports the ratio of the estimate to the true error.

--kinds alternates between kinds of scenes:

    any   : the scenes above
    rub   : bodies in sliding contact with friction
    far   : starts that are mirrored, collapsed, scattered or in fast spin
    touch : bodies that fall on an edge or a corner

The exit status is 1 if a step reports less than a third of its true error, or if a scene ends in
a fault. --only K runs scene K alone, keeps its files in out/error_study/SEED, and prints each step.
"""

import json
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import lab

import numpy as np
import tomli_w
import trimesh

from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.presets import PRESETS

# ratio of estimate to true error below which an estimate is bad
LEAST = 1 / 3
# time limit of a scene [s]
SECONDS = 300
KINDS = ("any", "rub", "far", "touch")
# true error below which rounding prevents a comparison
ROUNDING = 1e-9
ERRORS = (1e-1, 1e-2, 1e-3, 1e-3, 1e-3, 1e-5)
# exit status of each expected end; any other status is a fault
ENDS = {"done": 0, "stopped": 3, "refused": 2, "cut off": None}
FOLDER = lab.OUT / "error_study"
Draw = np.random.Generator


def draw_scene(seed: int, number: int, folder: Path, kind: str = "any") -> Path:
    """Write scene ``number`` of a seed with its meshes; return the scene's path."""
    folder.mkdir(parents=True, exist_ok=True)
    draw = np.random.default_rng([seed, number])
    path = folder / f"hard_{number}.toml"
    scene = rubbing(draw, path) if kind == "rub" else any_scene(draw, path)
    if kind == "far":
        start_far(draw, scene)
    if kind == "touch":
        touch(draw, scene, trimesh.load(folder / scene["mesh"]["source"]).bounds)
    path.write_text(tomli_w.dumps(scene))
    return path


def any_scene(draw: Draw, path: Path) -> dict:
    """Return a scene of a single body, and write its mesh."""
    sides = np.array(SIDES[draw.integers(len(SIDES))])
    scene: dict = {
        "mesh": {"source": mesh_of(draw, sides, path.with_suffix(".obj"))},
        "cages": {"count": int(draw.integers(40, 151))},
        "material": material_of(draw),
        "time": {"step": log_uniform(draw, 1e-4, 0.2), "duration": 0.0},
        "output": {"surface": False},
        "solver": solver_of(draw),
    }
    scene["time"]["duration"] = 3 * scene["time"]["step"]
    if draw.random() < 0.25:
        scene["time"]["integrator"] = "bdf2"
    if draw.random() < 0.8:
        scene["gravity"] = {"acceleration": [0.0, 0.0, -9.81]}
    for chance, add in (
        (0.7, add_start),
        (0.4, add_pin),
        (0.45, add_plates),
        (0.3, add_part),
        (0.2, add_anchor),
    ):
        if draw.random() < chance:
            add(draw, scene, sides)
    return scene


def rubbing(draw: Draw, path: Path) -> dict:
    """Return a scene in which a block moves down onto a slab, then slides and turns on it."""
    step: float = log_uniform(draw, 1e-3, 2e-2)
    bodies: list[dict] = []
    for name, low, high in (("block", [-0.15, -0.15, 0.0015], [0.15, 0.15, 0.1515]), SLAB):
        box = trimesh.creation.box(bounds=[low, high]).subdivide().subdivide()
        box.export(mesh := path.with_name(f"{path.stem}_{name}.ply"))
        bodies.append({"mesh": {"source": mesh.name}})
    down = [0.0, 0.0, -float(draw.uniform(0.005, 0.03))]
    along = {
        "by": [*draw.normal(0, 0.1, 2).tolist(), down[2]],
        "turn": [0.0, 0.0, float(draw.normal(0, 60))],
    }
    poses = [{"time": step, "by": down}, {"time": 4 * step} | along]
    bodies[0]["anchor"] = [
        {"region": {"box": [[-0.1, -0.1, 0.85], [1.1, 1.1, 1.1]], "relative": True}, "path": poses}
    ]
    bodies[1]["pin"] = [
        {"region": {"box": [[-0.1, -0.1, -0.1], [1.1, 1.1, 0.3]], "relative": True}}
    ]
    solid = {"law": "neo-hookean", "poisson_ratio": float(draw.choice([0.1, 0.25, 0.45]))}
    return {
        "body": bodies,
        "cages": {"cell_size": 0.075},
        "material": {"young_modulus": log_uniform(draw, 1e4, 1e7), "density": 1000.0} | solid,
        "time": {"step": step, "duration": 4 * step},
        "self_contact": {
            "distance": log_uniform(draw, 2e-4, 1e-3),
            "friction": float(draw.uniform(0.1, 1)),
        },
        "output": {"surface": False},
        "solver": {
            "preset": str(draw.choice(["newton", "newton-multigrid"])),
            "error": float(draw.choice(ERRORS[1:3])),
        },
    }


def start_far(draw: Draw, scene: dict) -> None:
    """Start a scene far from rest: mirrored or collapsed along an axis, scattered or spinning."""
    scale = [1.0, 1.0, 1.0]
    scale[draw.integers(3)] = float(draw.choice([-1.0, -0.5, 0.0, 0.01]))
    scene["start"] = {"scale": scale, "scatter": float(draw.choice([0.0, 0.1, 1.0]))}
    if draw.random() < 0.5:
        scene["start"]["spin"] = draw.normal(0, log_uniform(draw, 1, 200), 3).tolist()


def touch(draw: Draw, scene: dict, bounds: np.ndarray) -> None:
    """Add a ground that the body's lowest point meets in the first or the second step."""
    speed = log_uniform(draw, 0.1, 10)
    response = str(draw.choice(["penalty", "penalty", "reflect"]))
    gap = float(draw.uniform(0.1, 2)) * speed * scene["time"]["step"]
    plane = {
        "shape": "plane",
        "point": [0.0, 0.0, bounds[0, 2] - gap],
        "normal": [0.0, 0.0, 1.0],
        "response": response,
    }
    friction = {"friction": float(draw.uniform(0.1, 1))} if response == "penalty" else {}
    scene["obstacle"] = [plane | friction]
    scene["start"] = {"velocity": [*draw.normal(0, 1, 2).tolist(), -speed]}


SLAB = "slab", [-0.25, -0.25, -0.1], [0.25, 0.25, 0.0]
SIDES = ([1, 0.25, 0.25], [1, 0.12, 0.12], [0.5, 0.5, 0.5], [1, 1, 0.15], [0.6, 0.6, 0.6])


def log_uniform(draw: Draw, low: float, high: float) -> float:
    """Return a number whose logarithm is uniformly distributed."""
    return float(np.exp(draw.uniform(np.log(low), np.log(high))))


def mesh_of(draw: Draw, sides: np.ndarray, path: Path) -> str:
    """Write a box, or a ball in place of the last of ``SIDES``; return the file's name."""
    mesh = trimesh.creation.icosphere(2, 0.3) if sides[0] == 0.6 else trimesh.creation.box(sides)
    # alignment with the grid would hide faults
    if draw.random() < 0.5:
        mesh.apply_transform(trimesh.transformations.random_rotation_matrix(draw.random(3)))
    mesh.export(path)
    return path.name


def material_of(draw: Draw) -> dict:
    """Return a material with a random law and stiffness."""
    law = "linear" if draw.random() < 0.6 else "neo-hookean"
    return {"young_modulus": log_uniform(draw, 1e3, 1e9), "density": 1000.0, "law": law}


def solver_of(draw: Draw) -> dict:
    """Return solver settings with a random preset and a random error or iteration budget."""
    preset = str(draw.choice(list(PRESETS)))
    if draw.random() < 0.1:
        return {"preset": preset, "max_iterations": int(draw.integers(1, 20))}
    return {"preset": preset, "error": float(draw.choice(ERRORS))}


def add_start(draw: Draw, scene: dict, _: np.ndarray) -> None:
    """Add a random deformation, spin and velocity at the start."""
    start = scene["start"] = {}
    kind = draw.integers(5)
    if kind == 0:
        start["scale"] = [1.0, 1.0, 1.0]
        start["scale"][draw.integers(3)] = log_uniform(draw, 0.02, 0.9)
    elif kind == 1:
        start["scale"] = [float(s) for s in draw.uniform(0.3, 2.0, 3)]
    elif kind == 2:
        axis = [0.0, 0.0, 0.0]
        axis[draw.integers(3)] = 1.0
        start["twist"] = {"axis": axis, "degrees": float(draw.uniform(20, 270))}
    elif kind == 3:
        start["scatter"] = log_uniform(draw, 0.01, 1.0)
    if draw.random() < 0.4:
        start["spin"] = [float(w) for w in draw.normal(0, 5, 3)]
    if draw.random() < 0.4:
        start["velocity"] = [float(v) for v in draw.normal(0, 3, 3)]


def add_pin(draw: Draw, scene: dict, _: np.ndarray) -> None:
    """Pin the body's end at low x."""
    scene["pin"] = [{"region": {"box": [[-0.1, -0.1, -0.1], [0.15, 1.1, 1.1]], "relative": True}}]


def add_plates(draw: Draw, scene: dict, sides: np.ndarray) -> None:
    """Add the ground and, in half of the scenes, a plate that comes down."""
    half = 0.5 * sides[2] if sides[0] != 0.6 else 0.3
    response = "reflect" if draw.random() < 0.15 else "penalty"
    ground: dict = {
        "shape": "plane",
        "point": [0.0, 0.0, -half - 0.01],
        "normal": [0.0, 0.0, 1.0],
        "response": response,
    }
    if response == "penalty" and draw.random() < 0.6:
        ground["friction"] = float(draw.uniform(0, 1))
    scene["obstacle"] = [ground]
    if response == "penalty" and draw.random() < 0.5:
        by = [0.0, 0.0, -float(draw.uniform(0.1, 1.5)) * half]
        path = [{"time": scene["time"]["duration"], "by": by}]
        plate = {
            "shape": "plane",
            "point": [0.0, 0.0, half],
            "normal": [0.0, 0.0, -1.0],
            "path": path,
        }
        scene["obstacle"].append(plate | {"response": "penalty"})


def add_part(draw: Draw, scene: dict, _: np.ndarray) -> None:
    """Make half of the body stiffer, by a contrast of up to 1e6."""
    contrast = log_uniform(draw, 1, 1e6)
    region = {"half_space": {"point": [0.5, 0.5, 0.5], "normal": [1.0, 0.0, 0.0]}, "relative": True}
    stiff = min(contrast * scene["material"]["young_modulus"], 1e12)
    scene["part"] = [{"region": region, "young_modulus": stiff}]


def add_anchor(draw: Draw, scene: dict, sides: np.ndarray) -> None:
    """Move the body's end at high x by an anchor."""
    by = [float(x) for x in draw.normal(0, 0.3, 3) * sides[0]]
    region = {"box": [[0.85, -0.1, -0.1], [1.1, 1.1, 1.1]], "relative": True}
    scene["anchor"] = [{"region": region, "path": [{"time": scene["time"]["duration"], "by": by}]}]


def measured(seed: int, changes: list[str], kinds: list[str], number: int) -> dict:
    """Run a scene with changed keys; return its status, message and errors of its steps.

    ``steps`` has a pair for each step: the estimate and the true error.
    """
    scene = draw_scene(seed, number, FOLDER / str(seed), kinds[number % len(kinds)])
    result = scene.with_suffix(".h5")
    result.unlink(missing_ok=True)
    run = lab.run(scene, result, ["--true-error", 1, "--quiet"], changes, timeout=SECONDS)
    solver = load_scene(scene).solver
    steps: list = []
    # a run that failed has the steps before the failure
    if result.exists():
        frames = run.frames("step_error", "true_error")
        steps = np.transpose([frames["step_error"], frames["true_error"]]).tolist()
    row = {"number": number, "preset": solver.preset, "goal": solver.error, "status": run.status}
    return row | {"said": run.failure, "steps": steps}


def ratios_of(rows: list[dict]) -> np.ndarray:
    """Return estimate over true error for the steps whose true error is above rounding."""
    pairs = np.array([step for row in rows for step in row["steps"]]).reshape(-1, 2)
    known = pairs[np.isfinite(pairs[:, 1]) & (pairs[:, 1] > ROUNDING)]
    return known[:, 0] / known[:, 1]


def row_of(name: str, rows: list[dict]) -> lab.Row:
    """Return the row of a preset: numbers of ends, and quantiles of estimate over true error."""
    statuses = [row["status"] for row in rows]
    ratios = ratios_of(rows)
    entries: dict[str, object] = {"preset": name} | {
        word: statuses.count(status) for word, status in ENDS.items()
    }
    entries["faults"] = len(rows) - sum(statuses.count(status) for status in ENDS.values())
    finite = ratios[np.isfinite(ratios)]
    lowest = ["", "", ""]
    if len(finite):
        lowest = [f"{quantile:.2g}" for quantile in np.quantile(finite, (0, 0.05, 0.5))]
    entries |= {"steps": len(ratios)} | dict(
        zip(("least ratio", "5%", "median"), lowest, strict=True)
    )
    return entries | {"below 1/3": int((ratios < LEAST).sum())}


def bad(row: dict) -> bool:
    """Return whether a scene ended in a fault or has a step with a bad estimate."""
    return row["status"] not in ENDS.values() or bool((ratios_of([row]) < LEAST).any())


def main() -> int:
    """Print the table of all scenes, or the steps of a scene; return the exit status."""
    options = lab.parser(__doc__)
    options.add_argument("--scenes", type=int, default=500)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--kinds", nargs="+", choices=KINDS, default=["any"])
    options.add_argument("--only", type=int)
    options.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    args = options.parse_args()
    if args.only is not None:
        row = measured(args.seed, args.set, args.kinds, args.only)
        print(json.dumps(row, indent=1))
        return int(bad(row))
    with ThreadPoolExecutor(2) as pool:
        rows = list(
            pool.map(partial(measured, args.seed, args.set, args.kinds), range(args.scenes))
        )
    for row in filter(bad, rows):
        steps = " ".join(f"{said:.2g}/{true:.2g}" for said, true in row["steps"])
        print(
            f"scene {row['number']}, {row['preset']}, goal {row['goal']}: {steps} {row['said']}",
            file=sys.stderr,
        )
    names = sorted({row["preset"] for row in rows})
    of_presets = [row_of(name, [row for row in rows if row["preset"] == name]) for name in names]
    lab.heading()
    lab.table([*of_presets, row_of("all", rows)])
    return int(any(map(bad, rows)))


if __name__ == "__main__":
    sys.exit(main())
