#!/usr/bin/env python3
"""One lattice in several programs: time and trajectory error of ours, Newton, MuJoCo and pyPBD.

    scripts/bench_peers.py [--cells X Y Z] [--frames N] [--only WORD] [--timeout S] [-o PAGE]

A beam of 40 x 15 x 15 cells of 25 mm (E = 5e5 Pa, 1000 kg/m^3), one end pinned, is let go under its weight; frames are
of 1/60 s. Every program gets the same nodes, masses, springs and stiffnesses, a process of its own and one core, the
same for all; reading positions is not timed. The trajectory error is the rms distance of all nodes in all frames from a
run of our Verlet integrator with substeps of 50 us, relative to the rms displacement. Of ours the largest error of a
step stands beside it.

A program that is not ours is a class that takes substeps (`advance`) and gives `positions` (n, 3) [m]. Gravity points
along -z.
"""

import os
from argparse import SUPPRESS, Namespace
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import lab

import numpy as np
import trimesh

from msmpetsc.results.reader import Result

SCENE, FOLDER = "studies/beam_soft", lab.OUT / "bench_peers"
CELL, FRAME, G = 0.025, 1 / 60, 9.81  # [m], [s], [m/s^2]
REFERENCE = ['time.integrator="verlet"', "time.substep=5e-5"]
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
OURS = "msmpetsc"
ARENA = 4 << 30  # [byte] of MuJoCo: what it reckons with by itself grows as nodes times springs


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
        nodes, mass, springs, rest_length, stiffness = (result[f"lattice/{name}"][:] for name in names)
        pinned = np.zeros(len(nodes), bool)
        pinned[result["lattice/pinned"][:]] = True
    corner = np.rint((nodes - nodes.min(axis=0)) / rest_length.min()).astype(int)
    return Beam(nodes, mass, springs, rest_length, stiffness, pinned, corner)


# ---- Newton: particles and springs, in single precision


class Newton:
    """NVIDIA's Newton on the CPU."""

    def __init__(self, beam: Beam, time_step: float, iterations: int | None):
        """With VBD if a number of iterations is given, else semi-implicit."""
        import newton

        self.time_step = time_step
        builder: Any = newton.ModelBuilder(gravity=(0.0, 0.0, -G))
        still = [(0.0, 0.0, 0.0)] * len(beam.nodes)
        builder.add_particles(beam.nodes.tolist(), still, np.where(beam.pinned, 0, beam.mass).tolist())
        for (i, j), stiffness in zip(beam.springs.tolist(), beam.stiffness.tolist(), strict=True):
            builder.add_spring(i, j, ke=stiffness, kd=0.0, control=0.0)
        colour = beam.corner % 2 @ [4, 2, 1]  # no spring joins two nodes of one; its own coloring does not see springs
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


# ---- MuJoCo: a body of three sliding joints for each node, a spatial tendon for each spring


class MuJoCo:
    """MuJoCo with one of its integrators: EULER (semi-implicit) or DISCRETE (linearly implicit)."""

    def __init__(self, beam: Beam, time_step: float, integrator: str):
        import mujoco

        self.mujoco, self.rest, self.free = mujoco, beam.nodes, ~beam.pinned
        spec = mujoco.MjSpec()
        spec.memory = ARENA
        spec.option.timestep, spec.option.gravity = time_step, [0, 0, -G]
        spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}")
        self._add_nodes(spec, beam)
        for (i, j), k, rest_length in zip(beam.springs, beam.stiffness, beam.rest_length, strict=True):
            tendon = spec.add_tendon(stiffness=[k, 0, 0], springlength=[rest_length, rest_length])
            tendon.wrap_site(str(i))
            tendon.wrap_site(str(j))
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def _add_nodes(self, spec: Any, beam: Beam) -> None:
        slide = self.mujoco.mjtJoint.mjJNT_SLIDE
        for i, (position, mass, pinned) in enumerate(zip(beam.nodes, beam.mass, beam.pinned, strict=True)):
            if pinned:
                spec.worldbody.add_site(name=str(i), pos=position)
                continue
            body = spec.worldbody.add_body(pos=position, mass=mass, inertia=[mass] * 3, explicitinertial=True)
            body.add_site(name=str(i))
            for axis in np.eye(3):
                body.add_joint(type=slide, axis=axis)

    def advance(self, substeps: int) -> None:
        self.mujoco.mj_step(self.model, self.data, substeps)

    def positions(self) -> np.ndarray:
        positions = self.rest.copy()
        positions[self.free] += self.data.qpos.reshape(-1, 3)
        return positions


# ---- pyPBD: particles and XPBD's distance constraints, of compliance 1/k


class PyPBD:
    """Position based dynamics with compliance; its gravity points along -y, so that axes are passed on as y, z, x."""

    def __init__(self, beam: Beam, time_step: float, iterations: int):
        import pypbd

        self.pypbd, self.time_step, self.count = pypbd, time_step, len(beam.nodes)
        simulation = pypbd.Simulation.getCurrent()
        simulation.initDefault()
        self.model, self.stepper = simulation.getModel(), simulation.getTimeStep()
        self.particles = self.model.getParticles()
        for position in np.roll(beam.nodes, -1, axis=1):
            self.particles.addVertex(position)
        for i, mass in enumerate(np.where(beam.pinned, 0, beam.mass)):
            self.particles.setMass(i, mass)
        for (i, j), k in zip(beam.springs.tolist(), beam.stiffness.tolist(), strict=True):
            self.model.addDistanceConstraint_XPBD(i, j, k)  # at rest as it is
        self.model.initConstraintGroups()
        self.stepper.setValueUInt(pypbd.TimeStepController.MAX_ITERATIONS, iterations)

    def advance(self, substeps: int) -> None:
        self.pypbd.TimeManager.getCurrent().setTimeStepSize(substeps * self.time_step)
        self.stepper.setValueUInt(self.pypbd.TimeStepController.NUM_SUB_STEPS, substeps)
        self.stepper.step(self.model)

    def positions(self) -> np.ndarray:
        return np.roll([self.particles.getPosition(i) for i in range(self.count)], 1, axis=1)


# ---- by name: the package, and how to start from a beam, a substep [s] and a number of iterations

PEERS: dict[str, tuple[str, Callable[[Beam, float, int], Any]]] = {
    "semi-implicit": ("newton", lambda beam, time_step, _: Newton(beam, time_step, None)),
    "vbd": ("newton", Newton),
    "euler": ("mujoco", lambda beam, time_step, _: MuJoCo(beam, time_step, "EULER")),
    "discrete": ("mujoco", lambda beam, time_step, _: MuJoCo(beam, time_step, "DISCRETE")),
    "xpbd": ("pypbd", PyPBD),
}


# ---- runs


class Case(NamedTuple):
    """A way to step the beam; by one of PEERS, or an integrator of ours."""

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
    """Run a peer in a process of its own; why it failed if it did."""
    path = FOLDER / f"{case.peer}.npz"
    words = ["--frames", setup.frames, "--play", case.peer, setup.reference, path, case.substeps, case.iterations]
    ended = lab.python([Path(__file__), *words], path.with_suffix(".log"), timeout=setup.timeout)
    if ended.reason:
        return ended.reason
    with np.load(path) as left:
        return Trajectory(left["seconds"], left["position"], None, str(left["version"]))


def play(args: Namespace) -> None:
    """Step the lattice of a result by a peer; its seconds, positions, version and note into a file."""
    name, result, out, substeps, iterations = args.play
    package, start = PEERS[name]
    os.chdir(Path(out).parent)  # where MuJoCo leaves its log
    peer = start(read_beam(Path(result)), FRAME / int(substeps), int(iterations))
    positions, seconds = [peer.positions()], []
    for _ in range(args.frames):
        begin = perf_counter()
        peer.advance(int(substeps))
        seconds.append(perf_counter() - begin)
        positions.append(peer.positions())
    np.savez(out, position=positions, seconds=seconds, version=version(package))


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
            "trajectory error": float(np.linalg.norm(found.position - true) / np.linalg.norm(true - true[0])),
            "note": "",
        }


def main() -> None:
    options = lab.parser(__doc__)
    options.add_argument("--cells", type=int, nargs=3, default=[40, 15, 15], metavar="N", help="along x, y, z")
    options.add_argument("--frames", type=int, default=30, metavar="N")
    options.add_argument("--only", default="", metavar="WORD", help="cases whose program or method has this word")
    options.add_argument("--timeout", type=float, default=600, metavar="S", help="of each program [s]")
    options.add_argument("--play", nargs=5, help=SUPPRESS)  # what theirs() starts
    args = options.parse_args()
    if args.play:
        play(args)
        return
    use_one_core()
    cases = [case for case in CASES if args.only.lower() in f"{case.program} {case.method}".lower()]
    with lab.page(args):
        lab.table(rows(cases, set_up(args.cells, args.frames, args.timeout)))


if __name__ == "__main__":
    main()
