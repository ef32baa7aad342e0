#!/usr/bin/env python3
"""Runs the scenes small and holds their numbers against those of tests/regression. Needs the meshes.

    scripts/regression.py [SCENE...] [--ranks N] [--update]

Every scene of scenes/, or those named, at 400 cells, for a few steps, each solved to 1e-9, so that neither the number
of ranks nor the way in which a step is solved shows. Counts must be equal, the numbers of the last frame within the
tolerance.
Exit status 0: all are; 1: something differs, or nothing was compared. --update stores the numbers found.

Tolerance. A step solved to the relative error e leaves e |x* - y| in x, |x* - y| being at most about the largest
displacement D. What goes on from there carries it along in y = 2 q_n - q_(n-1): after N steps it is e D N (N + 1) / 2.
Ten times as much is allowed, for contact and buckling make differences grow; twice that in energies and momentum, in
which errors of x count double. Positions are relative to D, energies to the largest of the run (the potential one
counted from the start), momentum to that of the whole mass at the largest kinetic energy.
"""

import json
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter

from clone import ROOT, parser

import numpy as np

import msmpetsc
from msmpetsc.errors import InputError
from msmpetsc.geometry.registry import locate
from msmpetsc.study.process import environment, last_error

SCENES, STORED = ROOT / "scenes", ROOT / "tests" / "regression"
CELLS, ERROR = 400, 1e-9
GROWTH = 10  # of an error, by contact and buckling
FALLS = 30, ("mesh.base=[0, 0, 0.0005]",)  # 0.5 mm above the ground: there after 10 steps of 1 ms
DRAGS = 6, ()
# Steps, and what is changed so that these few show what the scene is about.
SETTINGS = {
    "armadillo_forehead": DRAGS,
    "armadillo_leg": DRAGS,
    "armadillo_palm": DRAGS,
    "brain_fall": FALLS,
    "bunny_fall": FALLS,
    "dragon_raise_push": (6, ("force.0.stop=0.16", "force.1.start=0.16")),
    "heart_pull": (10, ("anchor.0.path.0.time=0.08", "anchor.0.stop=0.12")),
    "lung_press": (6, ("obstacle.1.path.0={time=0.08, by=[0, 0, -0.04]}",)),
}
ENERGIES = ("kinetic", "elastic", "potential", "contact")
NODES = 5  # whose places are stored, evenly spread by their numbers
HEAD = f"{'scene':20} {'cells':>6} {'nodes':>6} {'springs':>8} {'off by':>9} {'allowed':>9} {'time':>7}"


def run(scene: str, path: Path, ranks: int) -> None:
    """Simulate; InputError if the mesh is not here, RuntimeError with the last line if the run fails."""
    file = SCENES / f"{scene}.toml"
    locate(tomllib.loads(file.read_text())["mesh"]["source"], SCENES)
    steps, changes = SETTINGS[scene]
    launcher = ["mpiexec", "-n", str(ranks)] if ranks > 1 else []
    options = [f"cages.count={CELLS}", "output.surface=false", *changes]
    command = [sys.executable, "-m", "msmpetsc", "run", file, "-o", path, "--overwrite", "--frames", steps]
    command += ["--error", ERROR, *(word for option in options for word in ("--set", option))]
    done = subprocess.run(
        [*launcher, *map(str, command)], env=environment(), stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(last_error(done.stderr) or f"exit status {done.returncode}")


def summary(path: Path, scene: str) -> dict:
    """What is stored of a scene: how it was run, counts, what errors are relative to, and the last frame's numbers."""
    with msmpetsc.open(path) as result:
        lattice, frames = result.lattice, result.frames
        rest, mass = lattice.nodes[:], lattice.mass[:]
        moved = max(np.linalg.norm(q - rest, axis=1).max() for q in frames.position)
        energies, q = {name: frames[name][:] for name in ENERGIES}, frames.position[-1]
        counts = {name: len(lattice[name]) for name in ("cells", "nodes", "springs", "pinned")}
        counts["frames"] = len(frames.time)
        momentum = frames.momentum[-1]
    some = np.linspace(0, len(q) - 1, NODES).astype(int)
    numbers = {name: ("J", values[-1]) for name, values in energies.items()}
    numbers |= {"momentum": ("kg m/s", momentum), "centre of mass": ("m", mass @ q / mass.sum())}
    numbers |= {"lowest corner": ("m", q.min(axis=0)), "highest corner": ("m", q.max(axis=0))}
    numbers |= {f"node {node}": ("m", q[node]) for node in some}
    scales = {
        "m": moved,
        "J": max(np.abs(values - (values[0] if name == "potential" else 0)).max() for name, values in energies.items()),
        "kg m/s": np.sqrt(2 * mass.sum() * energies["kinetic"].max()),
    }
    steps, changes = SETTINGS[scene]
    return {
        "run": {"cells asked for": CELLS, "error": ERROR, "steps": steps, "changes": list(changes)},
        "counts": counts,
        "scales": {unit: float(scale) for unit, scale in scales.items()},
        "numbers": {
            name: {"unit": unit, "value": np.asarray(value).tolist()} for name, (unit, value) in numbers.items()
        },
    }


def allowed(steps: int, unit: str) -> float:
    """Relative difference that the errors of so many steps may come to."""
    return GROWTH * ERROR * steps * (steps + 1) / 2 * (1 if unit == "m" else 2)


def differences(found: dict, stored: dict) -> Iterator[tuple[str, float, float]]:
    """Of each number what it is called, how far it is off, relative, and how much is allowed."""
    steps = stored["run"]["steps"]
    for name in found["numbers"].keys() | stored["numbers"].keys():
        one, other = found["numbers"].get(name), stored["numbers"].get(name)
        if (
            one is None
            or other is None
            or one["unit"] != other["unit"]
            or np.shape(one["value"]) != np.shape(other["value"])
        ):
            yield name, np.inf, 0.0
            continue
        apart = np.abs(np.subtract(one["value"], other["value"], dtype=float)).max()
        scale = stored["scales"][one["unit"]]
        relative = 0.0 if apart == 0 else float(apart / scale) if scale > 0 else np.inf
        yield name, np.inf if np.isnan(relative) else relative, allowed(steps, one["unit"])


def complaints(found: dict, stored: dict) -> list[str]:
    """One line for each thing that is not as stored."""
    if found["run"] != stored["run"]:
        return [f"is run otherwise than when it was stored ({stored['run']}): --update"]
    lines = [
        f"{name}: {found['counts'].get(name)}, stored {stored['counts'].get(name)}"
        for name in found["counts"].keys() | stored["counts"].keys()
        if found["counts"].get(name) != stored["counts"].get(name)
    ]
    for name, off, most in differences(found, stored):
        if off > most:
            values = [shown(numbers["numbers"].get(name)) for numbers in (found, stored)]
            lines.append(f"{name}: {values[0]}, stored {values[1]}: {off:.2g} off, {most:.2g} allowed")
    return sorted(lines)


def shown(number: dict | None) -> str:
    if number is None:
        return "not there"
    return f"{np.array2string(np.asarray(number['value']), precision=9)} {number['unit']}"


def check(scene: str, ranks: int, update: bool) -> list[str] | None:
    """Run a scene and print its row; what is wrong with it, None if its mesh is not here."""
    begun = perf_counter()
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{scene}.h5"
            run(scene, path, ranks)
            found = summary(path, scene)
    except InputError as error:
        print(f"{scene:20} skipped: {error}")
        return None
    except RuntimeError as error:
        print(f"{scene:20} FAILED")
        return [f"{scene}: {error}"]
    counts, file, off, most = found["counts"], STORED / f"{scene}.json", 0.0, allowed(SETTINGS[scene][0], "m")
    if update:
        file.parent.mkdir(exist_ok=True)
        file.write_text(json.dumps(found, indent=1) + "\n")
        wrong, verdict = [], "stored"
    elif not file.is_file():
        wrong, verdict = [f"{scene}: nothing is stored of it: --update"], "UNKNOWN"
    else:
        try:
            stored = json.loads(file.read_text())
            wrong = [f"{scene}: {line}" for line in complaints(found, stored)]
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
            print(f"{scene:20} UNKNOWN")
            return [f"{scene}: {file} is not what --update stores"]
        # the one nearest to what is allowed of it
        _, off, most = max(differences(found, stored), key=lambda row: row[1] / row[2] if row[2] else np.inf)
        verdict = "DIFFERS" if wrong else "same"
    sizes = f"{counts['cells']:6} {counts['nodes']:6} {counts['springs']:8}"
    print(f"{scene:20} {sizes} {off:9.1e} {most:9.1e} {perf_counter() - begun:5.1f} s {verdict}", flush=True)
    return wrong


def main(arguments: list[str] | None = None) -> int:
    options = parser(__doc__)
    options.add_argument("scenes", nargs="*", metavar="SCENE", help=f"of {', '.join(SETTINGS)}; all if none is named")
    options.add_argument("--ranks", type=int, default=1, metavar="N", help="MPI ranks of the runs (1)")
    options.add_argument("--update", action="store_true", help="store the numbers found in place of those there")
    args = options.parse_args(arguments)
    unknown = [scene for scene in args.scenes if scene not in SETTINGS]
    if unknown or args.ranks < 1:
        options.error(f"no scene {unknown[0]!r}: {', '.join(SETTINGS)}" if unknown else "--ranks must be at least 1")
    print(HEAD)
    outcomes = [check(scene, args.ranks, args.update) for scene in args.scenes or SETTINGS]
    for line in (line for wrong in outcomes if wrong for line in wrong):
        print(line)
    if all(outcome is None for outcome in outcomes):
        print("no scene was run")
    return int(all(outcome is None for outcome in outcomes) or any(outcomes))


if __name__ == "__main__":
    sys.exit(main())
