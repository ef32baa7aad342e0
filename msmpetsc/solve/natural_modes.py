"""Natural frequencies and mode shapes of a body about a state: K v = omega^2 M v.

K is the Hessian of the energy. H = M + tau^2 K of an implicit step has the same modes, and the
eigenvalues of M^(-1) H are 1 + (omega tau)^2. Unlike K, H is not singular for free bodies. The
multigrid of H approximates the inverse of K with the shift omega^2 = -1 / tau^2.
"""

from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Positions, Rows, to_host
from msmpetsc.build import Model
from msmpetsc.comm import reduced
from msmpetsc.environment import Environment
from msmpetsc.errors import InputError, StepFailed
from msmpetsc.scene.reading import Scene
from msmpetsc.scene.time import STATIC
from msmpetsc.solve.integrators.static import SLENDER, Static, rigid_motions_stopped, time_of_sound
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.free_bodies import bodies_of
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.lobpcg import Lobpcg
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.petsc.library import petsc_errors
from msmpetsc.solve.presets import find_preset
from msmpetsc.solve.simulate import TimeLoop

# Relative error of (omega tau)^2 at which a search ends [-]; frequencies have half this
# error
ACCURACY = 1e-7
# (omega tau)^2 below which a mode is rigid [-]; above rounding, and below the bending
# of bars a thousand times as long as thick
RIGID = 1e-5
# Relative difference of (omega tau)^2 up to which modes count as equal [-]; above
# ACCURACY
ALIKE = 1e-6
# Number of modes searched beyond the wanted modes [-]; lets all wanted modes converge
SPARE = 4
# Greatest number of iterations of a search [-]; 10 to 60 are usual, some 300 at large
# strain
MOST_ITERATIONS = 1000


@dataclass(frozen=True)
class Modes:
    """The lowest modes about a state: rigid modes first, then vibrations by frequency.

    frequencies : (k,) [Hz]; 0 for rigid modes, negative if a mode grows at that rate
    shapes      : (k, owned, 3) [-], orthonormal in M over all ranks, zero at fixed nodes
    position    : (owned, 3) [m] of the state
    rigid       : number of rigid modes
    """

    frequencies: Floats
    shapes: Rows
    position: Positions
    rigid: int


def modes_of(comm: MPI.Intracomm, scene: Scene, model: Model, count: int) -> Modes:
    """Return the lowest ``count`` modes of a scene's bodies (collective).

    The state is the last equilibrium of a static scene, the state that ``start.from`` names, or
    the rest shape. Pressures follow the surface, so they have stiffness, except at rest.

    Raises InputError if the bodies have fewer modes, and StepFailed if no state or mode is found.
    """
    if scene.time.integrator == STATIC:
        with TimeLoop(comm, scene, model) as loop:
            for _ in loop.advance():
                pass
            assert isinstance(loop.integrator, Static) and loop.integrator.last
            problem = loop.integrator.last.problem
            assert problem is not None
            time = scene.time.steps * scene.time.step
            return _about(loop.environment, loop.state.q, problem, time, count)
    is_given = any(start and start.from_ for start in scene.starts)
    q = model.start[0] if is_given else model.lattice.nodes
    environment = Environment(model)
    problem = StepProblem(q, q, np.zeros((model.lattice.owned, 3)))
    if is_given:
        problem = replace(problem, pressures=environment.forces.at(0.0).pressures.values)
    return _about(environment, q, problem, 0.0, count)


def _about(
    environment: Environment, q: Positions, problem: StepProblem, time: float, count: int
) -> Modes:
    """Return the lowest modes about positions q (l, 3) [m], with a problem's contact.

    time : time [s] whose anchors hold nodes
    """
    lattice = environment.lattice.pin(environment.anchors.fixed_at(time))
    comm, tau = lattice.table.comm, SLENDER * time_of_sound(lattice)
    preset = find_preset("newton-multigrid")
    touches, solid = environment.touches, environment.elasticity.solid
    stepper = Stepper(comm, lattice, tau, preset, touches=touches, solid=solid)
    try:
        functional, unknowns = stepper.functional, stepper.unknowns
        if count + SPARE > unknowns.total:
            raise InputError(
                f"--count {count}: {unknowns.total} free nodes show "
                f"{max(unknowns.total - SPARE, 0)} modes at most: give the body more cells"
            )
        stepper.set_up()
        functional.begin(replace(problem, q=q, y=q))
        with petsc_errors("PETSc cannot find modes", stepper):
            stepper.jacobian.linearise(functional.configuration(q), False, None)
            most = _most_rigid(unknowns)
            squares, modes = _lowest(stepper.optimality.curvature.search, count, most)
        order = np.lexsort((squares, squares != 0))
        shapes = np.zeros((count, lattice.owned, 3))
        shapes[:, unknowns.free] = modes[order].reshape(count, 3, -1).transpose(0, 2, 1)
    finally:
        stepper.destroy()
    frequencies = np.sign(squares) * np.sqrt(np.abs(squares)) / (2 * np.pi * tau)
    return Modes(frequencies[order], shapes, q[: lattice.owned], int((squares == 0).sum()))


def _most_rigid(unknowns: Unknowns) -> int:
    """Return an upper bound of the number of rigid modes (collective).

    A single body has as many as its holders leave. Each of several bodies may have six.
    """
    lattice, bodies = unknowns.lattice, len(bodies_of(unknowns).free)
    if bodies > 1:
        return 6 * bodies
    return 6 - rigid_motions_stopped(unknowns, to_host(lattice.fixed[: lattice.owned]))


def _lowest(search: Lobpcg, count: int, most: int) -> tuple[Floats, Rows]:
    """Return the lowest (omega tau)^2 (count,), 0 for rigid modes, and the modes (count, n).

    most : greatest number of rigid modes. Further modes may be as soft, beside a stiff part.

    Raises StepFailed if they do not converge.
    """
    block = count + SPARE
    start = [search.random(block)]
    for _, (values, modes, errors) in zip(
        range(MOST_ITERATIONS), search.iterates(start, block), strict=False
    ):
        squares = values[:count] - 1
        softest = np.argsort(np.abs(squares))[:most]
        squares[softest[np.abs(squares[softest]) < RIGID]] = 0.0
        error = (errors[:count] / np.where(squares, np.abs(squares), 1.0)).max()
        if error <= ACCURACY:
            return squares, _turned(search, squares, modes[:count])
    raise StepFailed(
        f"modes: not found in {MOST_ITERATIONS} iterations, the relative error is {error:.1e}",
        "modes",
    )


def _turned(search: Lobpcg, squares: Floats, modes: Rows) -> Rows:
    """Return the modes in a basis that does not depend on rounding.

    Mode i of a group of equal frequencies is orthogonal to the first i noise vectors, counted from
    0. Its product with noise vector i is positive.
    """
    noise = search.functional.noise(len(modes))
    parts = reduced(search.comm, (modes * search.functional.mass) @ noise.T)
    differ = np.diff(squares) > ALIKE * np.abs(squares[1:])
    for alike in np.split(np.arange(len(modes)), np.flatnonzero(differ) + 1):
        turn, upper = np.linalg.qr(parts[alike, : len(alike)])
        modes[alike] = (turn * np.sign(upper.diagonal())).T @ modes[alike]
    return modes
