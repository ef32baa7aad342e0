#!/usr/bin/env python3
"""One lattice in several programs: time and trajectory error of ours, Newton, MuJoCo and pyPBD.

    scripts/bench_peers.py [--cells X Y Z] [--frames N] [--only WORD] [--timeout S] [-o PAGE]

A beam of 40 x 15 x 15 cells of 25 mm (E = 5e5 Pa, 1000 kg/m^3), one end pinned, is let go under its weight; frames are
of 1/60 s. Every program gets the same nodes, masses, springs and stiffnesses, a process of its own and one core, the
same for all. The trajectory error is the rms distance of all nodes in all frames from a run of our Verlet integrator
with substeps of 50 us, relative to the rms displacement. Of ours the largest error of a step stands beside it.
"""

import os
from pathlib import Path
from typing import NamedTuple

import lab

import numpy as np
import trimesh
from peers import FRAME

SCENE, FOLDER = "studies/beam_soft", lab.OUT / "bench_peers"
CELL = 0.025  # [m]
REFERENCE = ['time.integrator="verlet"', "time.substep=5e-5"]
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
OURS = "msmpetsc"


class Case(NamedTuple):
    """A way to step the beam; by a peer of peers.py, or an integrator of ours."""

    program: str
    method: str
    peer: str
    substeps: int = 1
    iterations: int = 1


class Trajectory(NamedTuple):
    """What a run left: seconds (T,) of the frames' steps, positions (T + 1, n, 3) [m]."""

    seconds: np.ndarray
    position: np.ndarray
    step_error: float | None = None
    version: str = ""
    note: str = ""


class Setup(NamedTuple):
    """What all cases share; changes are those of our runs, the lattice is that of the reference's result."""

    changes: list[str]
    reference: Path
    frames: int
    timeout: float  # [s]


CASES = [
    Case(OURS, "implicit Euler, `newton` to 1e-3", "implicit-euler"),
    Case(OURS, "BDF2, `newton` to 1e-3", "bdf2"),
    Case(OURS, "Verlet, substeps by its limit", "verlet"),
    Case("Newton", "SemiImplicit, 20 substeps", "semi-implicit", 20),
    Case("Newton", "SemiImplicit, 200 substeps", "semi-implicit", 200),
    Case("Newton", "VBD, 1 step, 10 iterations", "vbd", 1, 10),
    Case("Newton", "VBD, 20 substeps, 5 iterations", "vbd", 20, 5),
    Case("MuJoCo", "Euler, 20 substeps", "euler", 20),
    Case("MuJoCo", "discrete, 1 step", "discrete", 1),
    Case("MuJoCo", "discrete, 10 substeps", "discrete", 10),
    Case("pyPBD", "XPBD, 5 substeps, 1 iteration", "xpbd", 5),
    Case("pyPBD", "XPBD, 100 substeps, 1 iteration", "xpbd", 100),
]


def use_one_core() -> None:
    """Keep this process and those it starts to one core and one thread, whatever their pools would like."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    os.environ.update(dict.fromkeys(THREADS, "1"))


def set_up(cells: list[int], frames: int, timeout: float) -> Setup:
    """Run the reference, whose lattice all programs take."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    mesh = FOLDER / "beam.obj"
    trimesh.creation.box(bounds=np.array([np.zeros(3), CELL * np.array(cells)])).export(mesh)
    changes = [f'mesh.source="{mesh}"', f"cages.cell_size={CELL}", f"time.duration={frames * FRAME}"]
    reference = lab.run(SCENE, FOLDER / "reference.h5", (), [*changes, *REFERENCE], timeout=timeout)
    return Setup(changes, reference.path, frames, timeout)


def ours(case: Case, setup: Setup) -> Trajectory | str:
    """Run a case of our own; why it failed if it did. Verlet's steps solve nothing and have no error."""
    changes = [*setup.changes, f'time.integrator="{case.peer}"']
    run = lab.run(SCENE, FOLDER / f"{case.peer}.h5", (), changes, timeout=setup.timeout)
    if run.failure:
        return run.failure
    frames = run.frames("wall_time", "step_error")
    return Trajectory(frames["wall_time"], positions(run.path), frames["step_error"].max() or None)


def positions(path: Path) -> np.ndarray:
    """Return the positions (T + 1, n, 3) [m] of all frames of a result."""
    return lab.Run(path).frames("position", start=0)["position"]


def theirs(case: Case, setup: Setup) -> Trajectory | str:
    """Run a peer; why it failed if it did."""
    path = FOLDER / f"{case.peer}.npz"
    words = ["--substeps", case.substeps, "--iterations", case.iterations, "--frames", setup.frames]
    script = [Path(__file__).with_name("peers.py"), case.peer, setup.reference, path, *words]
    ended = lab.python(script, path.with_suffix(".log"), timeout=setup.timeout)
    if ended.reason:
        return ended.reason
    with np.load(path) as left:
        return Trajectory(left["seconds"], left["position"], None, str(left["version"]), str(left["note"]))


def trajectory_error(position: np.ndarray, true: np.ndarray) -> float:
    """Return the rms distance from the true trajectory, relative to its rms displacement."""
    return float(np.linalg.norm(position - true) / np.linalg.norm(true - true[0]))


def rows(cases: list[Case], setup: Setup) -> lab.Rows:
    """Yield a row of each case, of the frames after the first, in which kernels are compiled."""
    true = positions(setup.reference)
    for case in cases:
        found = ours(case, setup) if case.program == OURS else theirs(case, setup)
        if isinstance(found, str):
            yield {"program": case.program, "method": case.method, "note": found}
            continue
        low, middle, high = (float(time) for time in np.percentile(1e3 * found.seconds[1:], (10, 50, 90)))
        yield {
            "program": f"{case.program} {found.version}".strip(),
            "method": case.method,
            "ms a frame": middle,
            "10%": low,
            "90%": high,
            "step error": found.step_error,
            "trajectory error": trajectory_error(found.position, true),
            "note": found.note,
        }


def main() -> None:
    options = lab.parser(__doc__)
    options.add_argument("--cells", type=int, nargs=3, default=[40, 15, 15], metavar="N", help="along x, y, z")
    options.add_argument("--frames", type=int, default=30, metavar="N")
    options.add_argument("--only", default="", metavar="WORD", help="cases whose program or method has this word")
    options.add_argument("--timeout", type=float, default=600, metavar="S", help="of each program [s]")
    args = options.parse_args()
    use_one_core()
    cases = [case for case in CASES if args.only.lower() in f"{case.program} {case.method}".lower()]
    with lab.page(args):
        lab.table(rows(cases, set_up(args.cells, args.frames, args.timeout)))


if __name__ == "__main__":
    main()
