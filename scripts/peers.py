#!/usr/bin/env python3
"""Steps the lattice of a result by a program that is not ours, in a process of its own: bench_peers.py starts it.

OUT (.npz) gets `position` (T, n, 3) [m], frame 0 among the T; `seconds` that the steps of each later frame took;
`version` and `note`. Reading positions is not timed. Gravity points along -z. A program is a class that takes substeps
(`advance`), gives `positions` (n, 3) [m], and may say in `note` what a reader of its figures must know.
"""

import os
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import lab

import numpy as np

from msmpetsc.errors import missing_package
from msmpetsc.results.reader import Result

FRAME = 1 / 60  # [s]
G = 9.81  # [m/s^2]
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


def color_groups(beam: Beam) -> list[np.ndarray]:
    """Return eight groups of nodes of which no spring joins two: corners of a cell differ in the parity of an index."""
    parity = beam.corner % 2 @ [4, 2, 1]
    return [np.flatnonzero(parity == color) for color in range(8)]


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
        builder.set_coloring(color_groups(beam))  # its own coloring does not see springs
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
        self.model, self.steps = spec.compile(), 0
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

    @property
    def note(self) -> str:
        """What it warned of in this run, where it did."""
        unsolved = self.data.warning[self.mujoco.mjtWarning.mjWARN_INERTIA].number
        return f"its linear solve did not converge in {unsolved} of {self.steps} steps, as it says" if unsolved else ""

    def advance(self, substeps: int) -> None:
        self.mujoco.mj_step(self.model, self.data, substeps)
        self.steps += substeps

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


def play(peer: Any, substeps: int, frames: int) -> dict:
    """Return what OUT gets, but for the version."""
    positions, seconds = [peer.positions()], []
    for _ in range(frames):
        start = perf_counter()
        peer.advance(substeps)
        seconds.append(perf_counter() - start)
        positions.append(peer.positions())
    return {"position": positions, "seconds": seconds, "note": getattr(peer, "note", "")}


def main() -> None:
    options = lab.parser(__doc__)
    options.add_argument("peer", choices=PEERS)
    options.add_argument("result", type=Path, help="a result file, whose lattice is taken")
    options.add_argument("out", type=Path, help="the .npz file to write")
    options.add_argument("--substeps", type=int, default=1, metavar="N", help="of a frame of 1/60 s")
    options.add_argument("--iterations", type=int, default=1, metavar="N", help="of a substep, where it iterates")
    options.add_argument("--frames", type=int, default=30, metavar="N")
    args = options.parse_args()
    package, start = PEERS[args.peer]
    os.chdir(args.out.parent)  # where MuJoCo leaves its log
    try:
        peer = start(read_beam(args.result), FRAME / args.substeps, args.iterations)
    except ModuleNotFoundError as error:
        sys.exit(str(missing_package(error.name or "")) if error.name == package else f"{package}: {error}")
    np.savez(args.out, version=version(package), **play(peer, args.substeps, args.frames))


if __name__ == "__main__":
    main()
