#!/usr/bin/env python3
"""Compare time and trajectory error of msmpetsc and of NVIDIA's Newton on the same lattice.

    scripts/bench_peers.py [--cells X Y Z] [--frames N] [--only WORD]

A clamped beam is released under its weight along -z. It has 40 x 15 x 15 cells of 25 mm with
E = 5e5 Pa and 1000 kg/m^3; frames last 1/60 s. Both programs get the same nodes, masses, springs
and stiffnesses, and run in a process of their own on a single core. Reading positions is not timed.
The trajectory error is the rms distance of all nodes in all frames from a reference run, relative
to the rms displacement. The reference is our Verlet integrator with substeps of 50 us. For our runs
the table also gives the largest step error.
"""

import os
from argparse import SUPPRESS, Namespace
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import lab

import numpy as np

from msmpetsc.results.reader import Result

SCENE = "studies/beam_soft"
FOLDER = lab.OUT / "bench_peers"
# [m], [s], [m/s^2]
CELL, FRAME, G = 0.025, 1 / 60, 9.81
REFERENCE = ['time.integrator="verlet"', "time.substep=5e-5"]
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
OURS = "msmpetsc"
# time limit of a program [s]
TIMEOUT = 600.0


class Beam(NamedTuple):
    """A lattice as in /lattice of a result; pinned (n,) bool, corner (n, 3) indices in the grid."""

    nodes: np.ndarray
    mass: np.ndarray
    springs: np.ndarray
    rest_length: np.ndarray
    stiffness: np.ndarray
    pinned: np.ndarray
    corner: np.ndarray


def read_beam(path: Path) -> Beam:
    """Return the lattice of a result."""
    with Result(path) as result:
        names = ("nodes", "mass", "springs", "rest_length", "stiffness")
        nodes, mass, springs, rest_length, stiffness = (
            result[f"lattice/{name}"][:] for name in names
        )
        pinned = np.zeros(len(nodes), bool)
        pinned[result["lattice/pinned"][:]] = True
    corner = np.rint((nodes - nodes.min(axis=0)) / rest_length.min()).astype(int)
    return Beam(nodes, mass, springs, rest_length, stiffness, pinned, corner)


# ---- Newton: particles and springs, in single precision


class Newton:
    """NVIDIA's Newton on the CPU."""

    def __init__(self, beam: Beam, time_step: float, iterations: int):
        """Build a model of the beam with VBD, or with the semi-implicit scheme for 0 iterations."""
        import newton

        self.time_step = time_step
        builder: Any = newton.ModelBuilder(gravity=(0.0, 0.0, -G))
        still = [(0.0, 0.0, 0.0)] * len(beam.nodes)
        builder.add_particles(
            beam.nodes.tolist(), still, np.where(beam.pinned, 0, beam.mass).tolist()
        )
        for (i, j), stiffness in zip(beam.springs.tolist(), beam.stiffness.tolist(), strict=True):
            builder.add_spring(i, j, ke=stiffness, kd=0.0, control=0.0)
        # springs join no nodes of equal colour; Newton's own colouring ignores springs
        colour = beam.corner % 2 @ [4, 2, 1]
        builder.set_coloring([np.flatnonzero(colour == of) for of in range(8)])
        model: Any = builder.finalize(device="cpu")
        model.spring_rest_length.assign(beam.rest_length)
        # switches off contact between particles
        model.particle_grid = None
        if iterations:
            self.solver = newton.solvers.SolverVBD(model, iterations=iterations)
        else:
            self.solver = newton.solvers.SolverSemiImplicit(model)
        self.state = model.state()
        self.next = model.state()
        self.control = model.control()

    def advance(self, substeps: int) -> None:
        """Take a number of substeps."""
        for _ in range(substeps):
            self.state.clear_forces()
            self.solver.step(self.state, self.next, self.control, None, self.time_step)
            self.state, self.next = self.next, self.state

    def positions(self) -> np.ndarray:
        """Return the node positions (n, 3) [m]."""
        return self.state.particle_q.numpy().astype(float)


# ---- runs


class Case(NamedTuple):
    """A method to step the beam: an integrator of msmpetsc, or substeps of Newton.

    iterations : iterations of VBD; 0 for the semi-implicit scheme
    """

    program: str
    method: str
    integrator: str = ""
    substeps: int = 1
    iterations: int = 0


class Trajectory(NamedTuple):
    """The motion of a run: seconds (T,) spent on each frame, positions (T + 1, n, 3) [m]."""

    seconds: np.ndarray
    position: np.ndarray
    step_error: float | None = None
    version: str = ""


class Setup(NamedTuple):
    """The common settings: changes of our scene, the reference's result, number of frames."""

    changes: list[str]
    reference: Path
    frames: int


CASES = [
    Case(OURS, "implicit Euler, `newton` to 1e-3", "implicit-euler"),
    Case(OURS, "BDF2, `newton` to 1e-3", "bdf2"),
    Case(OURS, "Verlet, substeps by its limit", "verlet"),
    Case("Newton", "SemiImplicit, 20 substeps", substeps=20),
    Case("Newton", "SemiImplicit, 200 substeps", substeps=200),
    Case("Newton", "VBD, 1 step, 10 iterations", iterations=10),
    Case("Newton", "VBD, 20 substeps, 5 iterations", substeps=20, iterations=5),
]


def use_one_core() -> None:
    """Restrict this process and its children to a single core and thread."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    os.environ.update(dict.fromkeys(THREADS, "1"))


def set_up(cells: list[int], frames: int) -> Setup:
    """Run the reference, whose lattice all programs use."""
    changes = [
        lab.box(FOLDER / "beam.obj", CELL * np.array(cells)),
        f"cages.cell_size={CELL}",
        f"time.duration={frames * FRAME}",
    ]
    reference = lab.run(SCENE, FOLDER / "reference.h5", (), [*changes, *REFERENCE], timeout=TIMEOUT)
    return Setup(changes, reference.path, frames)


def ours(case: Case, setup: Setup) -> Trajectory | str:
    """Run a case of msmpetsc; return its motion, or why it failed. Verlet has no step error."""
    changes = [*setup.changes, f'time.integrator="{case.integrator}"']
    run = lab.run(SCENE, FOLDER / f"{case.integrator}.h5", (), changes, timeout=TIMEOUT)
    if run.failure:
        return run.failure
    frames = run.frames("wall_time", "step_error")
    return Trajectory(frames["wall_time"], positions(run.path), frames["step_error"].max() or None)


def positions(path: Path) -> np.ndarray:
    """Return the positions (T + 1, n, 3) [m] of all frames of a result."""
    return lab.Run(path).frames("position", start=0)["position"]


def theirs(case: Case, setup: Setup) -> Trajectory | str:
    """Run Newton in a process of its own; return its motion, or why it failed."""
    path = FOLDER / "newton.npz"
    words = [
        "--frames",
        setup.frames,
        "--play",
        setup.reference,
        path,
        case.substeps,
        case.iterations,
    ]
    ended = lab.python([Path(__file__), *words], path.with_suffix(".log"), timeout=TIMEOUT)
    if ended.reason:
        return ended.reason
    with np.load(path) as saved:
        return Trajectory(saved["seconds"], saved["position"], None, str(saved["version"]))


def play(args: Namespace) -> None:
    """Step a result's lattice with Newton; write seconds, positions and version to a file."""
    result, out, substeps, iterations = args.play
    peer = Newton(read_beam(Path(result)), FRAME / int(substeps), int(iterations))
    positions = [peer.positions()]
    seconds = []
    for _ in range(args.frames):
        begin = perf_counter()
        peer.advance(int(substeps))
        seconds.append(perf_counter() - begin)
        positions.append(peer.positions())
    np.savez(out, position=positions, seconds=seconds, version=version("newton"))


def rows(cases: list[Case], setup: Setup) -> lab.Rows:
    """Yield a row for each case; its times leave out the first frame, which compiles kernels."""
    true = positions(setup.reference)
    for case in cases:
        motion = ours(case, setup) if case.program == OURS else theirs(case, setup)
        if isinstance(motion, str):
            yield {"program": case.program, "method": case.method, "note": motion}
            continue
        low, middle, high = (
            float(time) for time in np.percentile(1e3 * motion.seconds[1:], (10, 50, 90))
        )
        yield {
            "program": f"{case.program} {motion.version}".strip(),
            "method": case.method,
            "ms a frame": middle,
            "10%": low,
            "90%": high,
            "step error": motion.step_error,
            "trajectory error": float(
                np.linalg.norm(motion.position - true) / np.linalg.norm(true - true[0])
            ),
            "note": "",
        }


def main() -> None:
    """Print the table, or play a case in a child process."""
    options = lab.parser(__doc__)
    options.add_argument(
        "--cells", type=int, nargs=3, default=[40, 15, 15], metavar="N", help="along x, y, z"
    )
    options.add_argument("--frames", type=int, default=30, metavar="N")
    options.add_argument(
        "--only", default="", metavar="WORD", help="run cases whose program or method contains WORD"
    )
    # for the child process that theirs() starts
    options.add_argument("--play", nargs=4, help=SUPPRESS)
    args = options.parse_args()
    if args.play:
        play(args)
        return
    use_one_core()
    cases = [case for case in CASES if args.only.lower() in f"{case.program} {case.method}".lower()]
    lab.heading()
    lab.table(rows(cases, set_up(args.cells, args.frames)))


if __name__ == "__main__":
    main()
