#!/usr/bin/env python3
"""One lattice in several programs: time, step error and trajectory error of ours, Newton, MuJoCo and pyPBD.

    scripts/bench_peers.py [--cells X Y Z] [--frames N] [--only WORD] [--timeout S]

A beam of 40 x 15 x 15 cells of 25 mm (E = 5e5 Pa, 1000 kg/m^3), one end pinned, is let go under its weight; frames are
of 1/60 s. Every program gets the same nodes, masses, springs and stiffnesses, a process of its own and one core, the
same for all. Prints Markdown and leaves out/bench_peers.csv.

The trajectory error is the rms distance of all nodes in all frames from a run of our Verlet integrator with substeps
of 50 us, relative to the rms displacement. The step error is what our runs report, the largest; of an implicit
program, that of one substep after the last frame, against the step that `newton` solves to 1e-5.
"""

import csv
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from clone import ROOT, parser

import numpy as np
import trimesh
from mpi4py import MPI
from peers import FRAME, G

from msmpetsc.errors import StepFailed
from msmpetsc.model.build import build_model
from msmpetsc.model.lattice import Lattice
from msmpetsc.output.reader import Result
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.presets import find_preset

SCENE = ROOT / "scenes" / "studies" / "beam_soft.toml"
FOLDER = ROOT / "out" / "bench_peers"
CELL = 0.025  # [m]
REFERENCE = ['time.integrator="verlet"', "time.substep=5e-5"]
SPREAD = 10, 90  # percentiles
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
COLUMNS = ("program", "method", "ms a frame", "10%", "90%", "step error", "trajectory error")


class Ours(NamedTuple):
    """A run of our own, by its integrator."""

    method: str
    integrator: str
    program: str = "msmpetsc"


class Theirs(NamedTuple):
    """A run of a peer; implicit: whether its substep stands for one of implicit Euler."""

    program: str
    method: str
    peer: str
    substeps: int
    iterations: int = 1
    implicit: bool = True


class Trajectory(NamedTuple):
    """What a run left: seconds (T,) of the frames' steps, positions (T + 1, n, 3) [m]."""

    seconds: np.ndarray
    position: np.ndarray
    step_error: float | None
    version: str = ""
    note: str = ""


class Setup(NamedTuple):
    """What all cases share; settings are those of our runs, the lattice is that of the reference's result."""

    settings: list[str]
    reference: Path
    lattice: Lattice
    frames: int
    timeout: float  # [s]


class RunFailed(Exception):
    """A program that is missing, failed or took too long; one line."""


CASES: list[Ours | Theirs] = [
    Ours("implicit Euler, `newton` to 1e-3", "implicit-euler"),
    Ours("BDF2, `newton` to 1e-3", "bdf2"),
    Ours("Verlet, substeps by its limit", "verlet"),
    Theirs("Newton", "SemiImplicit, 20 substeps", "semi-implicit", 20, implicit=False),
    Theirs("Newton", "SemiImplicit, 200 substeps", "semi-implicit", 200, implicit=False),
    Theirs("Newton", "VBD, 1 step, 10 iterations", "vbd", 1, 10),
    Theirs("Newton", "VBD, 20 substeps, 5 iterations", "vbd", 20, 5),
    Theirs("MuJoCo", "Euler, 20 substeps", "euler", 20, implicit=False),
    Theirs("MuJoCo", "discrete, 1 step", "discrete", 1),
    Theirs("MuJoCo", "discrete, 10 substeps", "discrete", 10),
    Theirs("pyPBD", "XPBD, 5 substeps, 1 iteration", "xpbd", 5),
    Theirs("pyPBD", "XPBD, 100 substeps, 1 iteration", "xpbd", 100),
]


# ---- runs, each a process


def use_one_core() -> None:
    """Keep this process and those it starts to one core and one thread, whatever their pools would like."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    os.environ.update(dict.fromkeys(THREADS, "1"))


def run(command: list[str], timeout: float) -> None:
    """Run a Python command in FOLDER, where MuJoCo leaves its log; RunFailed with the last line that it wrote."""
    try:
        done = subprocess.run(
            [sys.executable, *command], cwd=FOLDER, timeout=timeout, capture_output=True, text=True, errors="replace"
        )
    except subprocess.TimeoutExpired:
        raise RunFailed(f"not done after {timeout:g} s") from None
    if done.returncode:
        said = (done.stderr + done.stdout).strip().splitlines()
        raise RunFailed(said[-1] if said else f"status {done.returncode}")


def overrides(cells: list[int]) -> list[str]:
    """Return what makes a scene of SCENE with so many cells, and write its mesh."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    sides = CELL * np.array(cells)
    trimesh.creation.box(bounds=[np.zeros(3), sides]).export(FOLDER / "beam.obj")
    return [f'mesh.source="{FOLDER / "beam.obj"}"', f"cages.cell_size={CELL}"]


def simulate(name: str, settings: list[str], frames: int, timeout: float) -> Path:
    """Return the result of a run of our own."""
    path = FOLDER / f"{name}.h5"
    sets = [word for setting in (*settings, f"time.duration={frames * FRAME}") for word in ("--set", setting)]
    run(["-m", "msmpetsc", "run", str(SCENE), "-o", str(path), "--overwrite", *sets], timeout)
    return path


def our_trajectory(path: Path) -> Trajectory:
    """Read a result; Verlet's steps solve nothing and have no error."""
    with Result(path) as result:
        frames = result.frames
        errors = frames.step_error[1:]
        return Trajectory(frames.wall_time[1:], frames.position[:], errors.max() if errors.any() else None)


def their_trajectory(case: Theirs, setup: Setup) -> Trajectory:
    path = FOLDER / f"{case.peer}.npz"
    numbers = {"--substeps": case.substeps, "--iterations": case.iterations, "--frames": setup.frames}
    words = [str(word) for pair in numbers.items() for word in pair]
    run([str(ROOT / "scripts" / "peers.py"), case.peer, str(setup.reference), str(path), *words], setup.timeout)
    with np.load(path) as left:
        last, seconds, position = left["last"], left["seconds"], left["position"]
        version, note = str(left["version"]), str(left["note"])
    error = step_error(setup.lattice, last, FRAME / case.substeps) if case.implicit else None
    return Trajectory(seconds, position, error, version, note)


def trajectory_of(case: Ours | Theirs, setup: Setup) -> Trajectory:
    """Run a case. Raises RunFailed."""
    if isinstance(case, Theirs):
        return their_trajectory(case, setup)
    settings = [*setup.settings, f'time.integrator="{case.integrator}"']
    return our_trajectory(simulate(case.integrator, settings, setup.frames, setup.timeout))


# ---- errors


def trajectory_error(position: np.ndarray, true: np.ndarray) -> float:
    """Return the rms distance from the true trajectory, relative to its rms displacement."""
    return float(np.linalg.norm(position - true) / np.linalg.norm(true - true[0]))


def step_error(lattice: Lattice, last: np.ndarray, time_step: float) -> float | None:
    """Return |x - x*| / |x* - y| in the norm of M of the last of three positions (3, n, 3); None without an x*.

    x* is the implicit Euler step after the first two, y = 2 q_n - q_(n-1).
    """
    before, q, x = last
    y, weight = 2 * q - before, lattice.mass[:, None] * np.array([0, 0, -G])
    if not np.isfinite(last).all():
        return None
    stepper = Stepper(MPI.COMM_SELF, lattice, time_step, find_preset("newton"), error=1e-5)
    try:
        stepper.set_up()
        solved = stepper.step(StepProblem(q, y, weight)).position
    except StepFailed:
        return None
    finally:
        stepper.destroy()
    root = np.sqrt(lattice.mass * ~lattice.pinned)[:, None]
    return float(np.linalg.norm(root * (x - solved)) / np.linalg.norm(root * (solved - y)))


# ---- the table


def row_of(case: Ours | Theirs, trajectory: Trajectory, true: np.ndarray) -> dict:
    """Return the columns, of the frames after the first, in which kernels are compiled."""
    milliseconds = 1e3 * trajectory.seconds[1:]
    low, high = np.percentile(milliseconds, SPREAD)
    numbers = np.median(milliseconds), low, high, trajectory.step_error, trajectory_error(trajectory.position, true)
    program = f"{case.program} {trajectory.version}".strip()
    return dict(zip(COLUMNS, (program, case.method, *numbers), strict=True)) | {"note": trajectory.note}


def shown(x: float | str | None) -> str:
    if x is None:
        return ""
    return x if isinstance(x, str) else f"{x:.0f}" if x >= 10 else f"{x:.2g}"


def print_markdown(rows: list[dict]) -> None:
    """The cases that ran, then what is to be said of some, a line for all methods of a program of which it is true."""
    print("\n|", " | ".join(COLUMNS), "|")
    print("|---" * len(COLUMNS) + "|")
    methods: dict[tuple[str, str], list[str]] = defaultdict(list)
    for row in rows:
        if "trajectory error" in row:
            print("|", " | ".join(shown(row[name]) for name in COLUMNS), "|")
        if row["note"]:
            methods[row["program"], row["note"]].append(row["method"])
    print("", *(f"- {program} ({'; '.join(of)}): {note}" for (program, note), of in methods.items()), sep="\n")


def measured(cases: list[Ours | Theirs], setup: Setup) -> Iterator[dict]:
    """Yield a row of each case, those that failed with a note alone."""
    true = our_trajectory(setup.reference).position
    for case in cases:
        print(f"{case.program}, {case.method}", file=sys.stderr)
        try:
            yield row_of(case, trajectory_of(case, setup), true)
        except RunFailed as failure:
            yield {"program": case.program, "method": case.method, "note": str(failure)}


def set_up(cells: list[int], frames: int, timeout: float) -> Setup:
    """Run the reference, whose lattice all programs take."""
    settings = overrides(cells)
    lattice = build_model(MPI.COMM_SELF, load_scene(SCENE, settings)).lattice
    reference = simulate("reference", [*settings, *REFERENCE], frames, timeout)
    return Setup(settings, reference, lattice, frames, timeout)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--cells", type=int, nargs=3, default=[40, 15, 15], metavar="N", help="along x, y, z")
    options.add_argument("--frames", type=int, default=30, metavar="N")
    options.add_argument("--only", default="", metavar="WORD", help="cases whose program or method has this word")
    options.add_argument("--timeout", type=float, default=600, metavar="S", help="of each program [s]")
    args = options.parse_args()
    use_one_core()
    cases = [case for case in CASES if args.only.lower() in f"{case.program} {case.method}".lower()]
    rows = list(measured(cases, set_up(args.cells, args.frames, args.timeout)))
    with open(FOLDER.with_suffix(".csv"), "w", newline="") as file:
        writer = csv.DictWriter(file, (*COLUMNS, "note"))
        writer.writeheader()
        writer.writerows(rows)
    print_markdown(rows)


if __name__ == "__main__":
    main()
