#!/usr/bin/env python3
"""One lattice in two programs: time and trajectory error of ours and of NVIDIA's Newton.

    scripts/bench_peers.py [--cells X Y Z] [--frames N] [--only WORD]

A beam of 40 x 15 x 15 cells of 25 mm (E = 5e5 Pa, 1000 kg/m^3), one end pinned, is let go under its weight; frames are
of 1/60 s. Both programs get the same nodes, masses, springs and stiffnesses, and a process of their own on one core;
reading positions is not timed. The trajectory error is the rms distance of all nodes in all frames from a
run of our Verlet integrator with substeps of 50 us, relative to the rms displacement. Of ours the largest error of a
step stands beside it. Gravity points along -z.
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

SCENE, FOLDER = "studies/beam_soft", lab.OUT / "bench_peers"
CELL, FRAME, G = 0.025, 1 / 60, 9.81  # [m], [s], [m/s^2]
REFERENCE = ['time.integrator="verlet"', "time.substep=5e-5"]
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
OURS = "msmpetsc"
TIMEOUT = 600.0  # [s] of each program


class Beam(NamedTuple):
    """A lattice, as /lattice of a result has it; pinned (n,) bool, corner (n, 3) the nodes' indices in the grid."""

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
        """Make a model of the beam, stepped by VBD with so many iterations; by the semi-implicit scheme with 0."""
        import newton

        self.time_step = time_step
        builder: Any = newton.ModelBuilder(gravity=(0.0, 0.0, -G))
        still = [(0.0, 0.0, 0.0)] * len(beam.nodes)
        builder.add_particles(
            beam.nodes.tolist(), still, np.where(beam.pinned, 0, beam.mass).tolist()
        )
        for (i, j), stiffness in zip(beam.springs.tolist(), beam.stiffness.tolist(), strict=True):
            builder.add_spring(i, j, ke=stiffness, kd=0.0, control=0.0)
        colour = (
            beam.corner % 2 @ [4, 2, 1]
        )  # no spring joins two nodes of one; its own coloring does not see springs
        builder.set_coloring([np.flatnonzero(colour == of) for of in range(8)])
        model: Any = builder.finalize(device="cpu")
        model.spring_rest_length.assign(beam.rest_length)
        model.particle_grid = None  # no contact between particles
        vbd, semi_implicit = newton.solvers.SolverVBD, newton.solvers.SolverSemiImplicit
        self.solver = vbd(model, iterations=iterations) if iterations else semi_implicit(model)
        self.state, self.next, self.control = model.state(), model.state(), model.control()

    def advance(self, substeps: int) -> None:
        for _ in range(substeps):
            self.state.clear_forces()
            self.solver.step(self.state, self.next, self.control, None, self.time_step)
            self.state, self.next = self.next, self.state

    def positions(self) -> np.ndarray:
        return self.state.particle_q.numpy().astype(float)


# ---- runs


class Case(NamedTuple):
    """A way to step the beam: an integrator of ours, or substeps of Newton's.

    iterations : of VBD; 0 for the semi-implicit scheme
    """

    program: str
    method: str
    integrator: str = ""
    substeps: int = 1
    iterations: int = 0


class Trajectory(NamedTuple):
    """What a run left: seconds (T,) of the frames' steps, positions (T + 1, n, 3) [m]."""

    seconds: np.ndarray
    position: np.ndarray
    step_error: float | None = None
    version: str = ""


class Setup(NamedTuple):
    """What all cases share; changes are those of our runs, the lattice is that of the reference's result."""

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
    """Keep this process and those it starts to one core and one thread, whatever their pools would like."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    os.environ.update(dict.fromkeys(THREADS, "1"))


def set_up(cells: list[int], frames: int) -> Setup:
    """Run the reference, whose lattice all programs take."""
    changes = [
        lab.box(FOLDER / "beam.obj", CELL * np.array(cells)),
        f"cages.cell_size={CELL}",
        f"time.duration={frames * FRAME}",
    ]
    reference = lab.run(SCENE, FOLDER / "reference.h5", (), [*changes, *REFERENCE], timeout=TIMEOUT)
    return Setup(changes, reference.path, frames)


def ours(case: Case, setup: Setup) -> Trajectory | str:
    """Run a case of our own; why it failed if it did. Verlet's steps solve nothing and have no error."""
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
    """Run Newton in a process of its own; why it failed if it did."""
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
    with np.load(path) as left:
        return Trajectory(left["seconds"], left["position"], None, str(left["version"]))


def play(args: Namespace) -> None:
    """Step the lattice of a result by Newton; its seconds, positions and version into a file."""
    result, out, substeps, iterations = args.play
    peer = Newton(read_beam(Path(result)), FRAME / int(substeps), int(iterations))
    positions, seconds = [peer.positions()], []
    for _ in range(args.frames):
        begin = perf_counter()
        peer.advance(int(substeps))
        seconds.append(perf_counter() - begin)
        positions.append(peer.positions())
    np.savez(out, position=positions, seconds=seconds, version=version("newton"))


def rows(cases: list[Case], setup: Setup) -> lab.Rows:
    """Yield a row of each case, of the frames after the first, in which kernels are compiled."""
    true = positions(setup.reference)
    for case in cases:
        found = ours(case, setup) if case.program == OURS else theirs(case, setup)
        if isinstance(found, str):
            yield {"program": case.program, "method": case.method, "note": found}
            continue
        low, middle, high = (
            float(time) for time in np.percentile(1e3 * found.seconds[1:], (10, 50, 90))
        )
        yield {
            "program": f"{case.program} {found.version}".strip(),
            "method": case.method,
            "ms a frame": middle,
            "10%": low,
            "90%": high,
            "step error": found.step_error,
            "trajectory error": float(
                np.linalg.norm(found.position - true) / np.linalg.norm(true - true[0])
            ),
            "note": "",
        }


def main() -> None:
    options = lab.parser(__doc__)
    options.add_argument(
        "--cells", type=int, nargs=3, default=[40, 15, 15], metavar="N", help="along x, y, z"
    )
    options.add_argument("--frames", type=int, default=30, metavar="N")
    options.add_argument(
        "--only", default="", metavar="WORD", help="cases whose program or method has this word"
    )
    options.add_argument("--play", nargs=4, help=SUPPRESS)  # what theirs() starts
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
