"""The explicit integrator against closed forms, numpy's eigenvalues and Coulomb's law."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import CELL, GRAVITY, G, block_scene, loop_of, plane_at, play, solid_of
from lattices import block, cages_of, dense_hessian, one_spring
from mpi4py import MPI

from msmpetsc.build import Model
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.environment import Environment
from msmpetsc.errors import StepFailed
from msmpetsc.fields import Frame
from msmpetsc.lattice.lattice import Lattice, build_lattice
from msmpetsc.scene.body import Material
from msmpetsc.scene.schema import Solver
from msmpetsc.scene.time import Time
from msmpetsc.solve.integrators.integrator import State
from msmpetsc.solve.integrators.verlet import Verlet

T = 1 / 60
COMM = MPI.COMM_SELF
EXPLICIT = {"integrator": "verlet"}


def integrator(lattice: Lattice, substep: float | None = None) -> Verlet:
    model = Model(
        None, lattice, None, [], [], [], [], (lattice.nodes, np.zeros_like(lattice.nodes))
    )
    time = Time(step=T, duration=1.0, substep=substep, **EXPLICIT)
    return Verlet(COMM, Environment(model), time, Solver(), "")


def fly(
    lattice: Lattice, q: np.ndarray, v: np.ndarray, steps: int, substep: float | None = None
) -> list[State]:
    """Return the states of a body without loads, at the start and after each step."""
    stepper, states = integrator(lattice, substep), [State(q, q - T * v)]
    try:
        for index in range(1, steps + 1):
            states.append(stepper.advance(states[-1], index * T)[1])
    finally:
        stepper.destroy()
    return states


def velocity(state: State) -> np.ndarray:
    return (state.q - state.q_previous) / T


def cube(law: str = "linear") -> Lattice:
    """Return a lattice of 2 x 2 x 2 cells of 0.1 m."""
    return build_lattice(
        cages_of(block(2, 2, 2), 0.1), Material(density=1000, young_modulus=2e4, law=law)
    )


def shaken(lattice: Lattice, size: float) -> np.ndarray:
    return lattice.nodes + size * np.random.default_rng(5).normal(size=lattice.nodes.shape)


# ---- closed forms


def test_one_mass_on_a_spring_follows_the_leapfrogs_own_dispersion():
    """The frequency has the dispersion of the leapfrog.

    x_n = cos(w n dt) and v_n = -sin(w dt) / dt sin(w n dt), with w = 2 / dt asin(omega dt / 2).
    Here omega^2 = k / m.
    """
    m, k, r, size, count = 0.3, 400.0, 1.0, 0.2, 4
    dt = T / count
    w = 2 / dt * np.arcsin(np.sqrt(k / m) * dt / 2)
    start = np.array([[0, 0, 0], [0, 0, r + size]])
    for n, state in enumerate(fly(one_spring(m, k, r), start, np.zeros((2, 3)), 50, substep=dt)):
        assert state.q[1, 2] - r == pytest.approx(size * np.cos(w * n * T), abs=1e-12)
        expected = -size * np.sin(w * dt) / dt * np.sin(w * n * T)
        assert velocity(state)[1, 2] == pytest.approx(expected, abs=1e-10)


def test_free_flight_keeps_momentum_and_angular_momentum():
    """The forces are central, and a kick changes v at constant q.

    So the leapfrog keeps r x m v, unlike implicit Euler.
    """
    lattice = cube()
    v = np.cross([0, 2, 9], lattice.nodes) + np.random.default_rng(1).normal(
        size=lattice.nodes.shape
    )
    states = fly(lattice, shaken(lattice, 0.01), v, 60)
    m = lattice.mass
    moments = np.array([(m @ velocity(s), m @ np.cross(s.q, velocity(s))) for s in states])
    np.testing.assert_allclose(
        moments, np.broadcast_to(moments[0], moments.shape), atol=1e-11 * np.abs(moments).max()
    )
    assert np.abs(states[-1].q - states[0].q).max() > 0.1


# ---- a beam

BEAM = {
    "sides": CELL * np.array([8, 2, 2]),
    "gravity": GRAVITY,
    "pin": [{"region": {"box": [[-1, -1, -1], [0.01, 1, 1]]}}],
}


def swing(folder: Path, step: float, duration: float, *overrides: str) -> tuple[Model, list[Frame]]:
    scene = block_scene(folder, **BEAM, time={"step": step, "duration": duration})
    return play(scene, *overrides)


VERLET = 'time.integrator="verlet"'


def test_the_energy_of_a_swinging_beam_stays_where_implicit_euler_loses_it(tmp_path: Path):
    def lost(frames: list[Frame]) -> tuple[float, float]:
        """Return the final and the greatest change of energy, over the greatest kinetic energy."""
        total = np.array([f.kinetic + f.elastic + f.potential for f in frames])
        away = np.abs(total - total[0]) / max(f.kinetic for f in frames)
        return away[-1], away.max()

    _, explicit = swing(tmp_path, T, 4.0, VERLET)
    # substeps of 1e-3 instead of 8.3e-3 have 1/70 of the square
    _, fine = swing(tmp_path, T, 4.0, VERLET, "time.substep=1e-3")
    _, implicit = swing(tmp_path, T, 0.5)
    assert lost(implicit)[0] > 0.2
    # 6% at the stability limit, which springs cut by the clamp determine; substeps with
    # a 70th of the square have at most a 40th of that
    assert lost(explicit)[1] < 0.07 and lost(fine)[1] < 0.07 / 40
    late = [f.kinetic for f in explicit if f.time > 3]
    # the oscillation continues
    assert max(late) > 0.5 * max(f.kinetic for f in explicit)


# ---- the stability limit


def greatest(lattice: Lattice, q: np.ndarray, projected: bool = False) -> float:
    """Return the greatest eigenvalue of M^(-1) (Hessian of E) over the free nodes, by numpy."""
    free = np.repeat(~lattice.pinned, 3)
    H = dense_hessian(Elasticity(lattice), q, projected)[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.repeat(lattice.mass, 3)[free])
    return np.linalg.eigvalsh(scale[:, None] * H * scale)[-1]


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
@pytest.mark.parametrize("held", [False, True])
def test_the_limit_is_that_of_the_greatest_eigenvalue(law: str, held: bool):
    lattice = cube(law)
    if held:
        lattice = lattice.pin(lattice.nodes[:, 0] < 1.01)
    q = shaken(lattice, 0.02)
    stepper = integrator(lattice)
    stepper.position.values[:] = q
    stepper._update_fixed(0.0)
    found, exact = stepper.highest.squared_at(stepper.position.values), greatest(lattice, q)
    stepper.destroy()
    assert 0.97 * exact < found <= greatest(lattice, q, projected=True) * (1 + 1e-12)


def test_a_substep_beyond_the_limit_is_shortened_and_a_shorter_one_kept(tmp_path: Path, caplog):
    scene = block_scene(tmp_path, time={"step": T, "duration": 3 * T} | EXPLICIT)
    counts = {
        s: [f.iterations for f in play(scene, f"time.substep={s}")[1][1:]] for s in (1.0, 1e-4)
    }
    usual = [f.iterations for f in play(scene)[1][1:]]
    assert counts[1.0] == usual and counts[1e-4] == [167] * 3
    told = [
        record.getMessage() for record in caplog.records if "time.substep" in record.getMessage()
    ]
    assert len(told) == 1 and "beyond the stability limit" in told[0]


@pytest.mark.parametrize("response", ["reflect", "penalty"])
def test_a_blow_that_stiffens_the_body_is_taken_in_shorter_substeps(tmp_path: Path, response: str):
    """omega at the impact of a soft block is more than twice that of the flight."""
    floor = plane_at(-0.05, response=response)
    material = solid_of(1e4)
    time = {"step": T, "duration": 0.4} | EXPLICIT
    scene = block_scene(
        tmp_path, time=time, material=material, gravity={"acceleration": [0, 0, -2 * G]},
        obstacle=[floor],
        cages={"cell_size": CELL / 2},
    )  # fmt: skip
    _, frames = play(scene)
    energy = np.array([f.kinetic + f.elastic + f.potential + f.contact for f in frames])
    steps = [f.iterations for f in frames[1:]]
    assert max(steps) > 2 * steps[0]
    assert np.abs(energy - energy[0]).max() < 0.025 * max(f.kinetic for f in frames)


def test_a_body_that_folds_gains_energy_that_is_told(tmp_path: Path):
    """Springs of nearly zero length turn round within a substep at the stability limit.

    Shorter substeps gain nothing.
    """
    scene = block_scene(
        tmp_path, sides=CELL * np.array([8, 2, 2]), time={"step": 0.1, "duration": 1.0} | EXPLICIT,
        start={"scale": [2, 1, 1]},
    )  # fmt: skip
    with pytest.raises(StepFailed, match=r"from nowhere.* try a smaller time\.substep"):
        play(scene)
    energy = np.array([f.kinetic + f.elastic for f in play(scene, "time.substep=5e-4")[1]])
    assert energy.max() < 1.02 * energy[0]


# ---- obstacles


def test_nodes_that_are_led_keep_to_their_path_and_are_let_go_with_its_speed(tmp_path: Path):
    left = {"box": [[-1, -1, -1], [0.01, 1, 1]]}
    path = [{"time": 1.0, "by": [0, 0, 0.5]}]
    anchors = [
        {"region": r, "path": path, "stop": 6.5 * T}
        for r in (left, {"box": [[0.1, -1, -1], [1, 1, 0.2]]})
    ]
    model, frames = play(
        block_scene(tmp_path, time={"step": T, "duration": 12 * T} | EXPLICIT, anchor=anchors)
    )
    prescribed = model.lattice.nodes[:, 0] == 0
    for frame in frames[:7]:
        place = model.lattice.nodes[prescribed] + [0, 0, 0.5 * frame.time]
        np.testing.assert_allclose(frame.position[prescribed], place, atol=1e-14)
    np.testing.assert_allclose(frames[-1].momentum, frames[7].momentum, atol=1e-10)
    # the rest of the body oscillates
    assert frames[-1].momentum[2] == pytest.approx(0.5 * model.lattice.mass.sum(), rel=0.2)


@pytest.mark.parametrize("stop", [6.0, 6.5])
def test_the_work_of_an_anchor_that_lets_go_is_no_energy_from_nowhere(tmp_path: Path, stop: float):
    """The anchor turns half a step before it lets go, and nodes keep the speed of the turn."""
    top = {"box": [[-1, -1, 0.2], [1, 1, 1]]}
    path = [
        {"time": time * T, "by": [0, 0, 0.03 * height]} for time, height in ((6.25, 1), (12, 6))
    ]
    anchor = [{"region": top, "path": path, "stop": stop * T}]
    time = {"step": T, "duration": 9 * T, "substep": 1e-4} | EXPLICIT
    _, frames = play(block_scene(tmp_path, time=time, anchor=anchor, gravity=GRAVITY))
    assert frames[6].kinetic + frames[6].elastic > 0.1
    assert max(frame.energy_gained for frame in frames) < 3e-3 * frames[6].kinetic


# angle of the slope [rad]
TILT = 0.3


def on_a_slope(folder: Path, friction: float, **time) -> Path:
    """Write the scene of a block on a plane, with tilted gravity."""
    floor = plane_at(response="penalty", friction=friction)
    gravity = {"acceleration": [G * np.sin(TILT), 0, -G * np.cos(TILT)]}
    return block_scene(folder, gravity=gravity, obstacle=[floor], time=time)


def settled(folder: Path, friction: float) -> tuple[Path, State]:
    """Return the scene and the state at rest on the slope, found by implicit Euler, which damps."""
    scene = on_a_slope(folder, friction, step=0.1, duration=5.0)
    q = play(scene, "solver.error=1e-6", "output.every=1000")[1][-1].position
    return scene, State(q, q)


def go_on(scene: Path, state: State, steps: int) -> tuple[Model, list[Frame]]:
    with loop_of(scene, VERLET, f"time.step={T}", f"time.duration={steps * T}") as simulation:
        simulation.state = state
        return simulation.model, list(simulation.frames())


def test_a_block_sticks_to_a_slope_below_the_angle_of_friction(tmp_path: Path):
    """The block rests half a second without creep; substeps are as long as without friction."""
    scene, state = settled(tmp_path, 2 * np.tan(TILT))
    _, frames = go_on(scene, state, 30)
    assert np.abs(frames[-1].position - state.q).max() < 1e-7


def test_a_block_slides_down_a_slope_by_coulombs_law(tmp_path: Path):
    """p_x = m g sin t - mu (p_z + m g cos t), for any course of the push.

    The total push is p_z + m g cos t.
    """
    mu, start = 0.5 * np.tan(TILT), settled(tmp_path, 0.5 * np.tan(TILT))[1]
    scene = on_a_slope(tmp_path, mu, step=T, duration=1.0)
    model, frames = go_on(scene, State(start.q, start.q), 30)
    m, last = model.lattice.mass.sum(), frames[-1]
    expected = m * G * np.sin(TILT) * last.time - mu * (
        last.momentum[2] + m * G * np.cos(TILT) * last.time
    )
    assert last.momentum[0] == pytest.approx(expected, rel=1e-6)
    assert last.momentum[0] == pytest.approx(
        m * G * (np.sin(TILT) - mu * np.cos(TILT)) * last.time, rel=1e-6
    )
