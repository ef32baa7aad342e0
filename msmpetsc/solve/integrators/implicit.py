"""Implicit Euler, and what BDF2 (bdf2.py) shares with it: each step is a minimisation.

Both integrators solve  M (x - y) + tau^2 (grad E(x) - f_ext) = 0  for x. They differ in y, the
positions without forces, and in tau, which is a fixed part of the time step t. In f_ext, loads are
means over steps, so that their impulse on a free body is their integral over time.

The velocity at the end is v = (x - c) / tau, and y = c + tau w. With mass-proportional damping,
forces -alpha M v, the step solves

    M (x - c - tau w) + tau alpha M (x - c) + tau^2 (grad E(x) - f_ext) = 0.

Division by 1 + alpha tau gives an undamped problem, so damping costs nothing:

    y = c + tau w / (1 + alpha tau)    and    tau^2 / (1 + alpha tau) for tau^2.

For a viscous solid, E contains the dissipation over the step (elasticity.viscosity), with x^ = c.
The cells' rotation in the viscosity is predicted for the middle of the step by implicit Euler, and
for its end by BDF2.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Indices, Mask, Positions
from msmpetsc.checkpoint import Checkpoint, Range
from msmpetsc.constraints.forces import ExternalForces
from msmpetsc.contact.obstacles.reflection import StepTaken
from msmpetsc.contact.step_contact import StepContactAt
from msmpetsc.environment import Environment
from msmpetsc.errors import StepFailed
from msmpetsc.scene.schema import Solver
from msmpetsc.scene.time import Time
from msmpetsc.solve.integrators.integrator import Integrator, State
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper, StepResult
from msmpetsc.solve.petsc.events import CONTACT
from msmpetsc.solve.presets import find_preset

# greatest number of solves until a step's contact faces are right; wrong faces let
# nodes pass through a thin obstacle
MOST_SOLVES = 10


@dataclass
class ContactFaces:
    """Find the obstacle faces at which nodes are in contact in a step. All methods are collective.

    The first solve takes the faces that nodes cross on the path from q to y. If the path to the
    solution x crosses faces that give other forces, the step is solved again. From then on a node
    keeps its face, so that the search ends.

    If the surface has few contacts at the start, the first solve uses only candidate pairs around
    these contacts, and no pairs without contacts. If the solution shows other contacts, the step is
    solved again with all candidates.

    q, y       : as in StepProblem
    load       : external forces
    before     : (o, l) faces at the start of the step; None for the nearest faces
    fixed      : (l,) bool, nodes that are not unknowns
    q_before   : (l, 3) [m] positions one step before q, for BDF2
    sides      : (o, l) faces of the next solve; in the end, the faces of the step
    is_settled : whether the last solve had the right contacts
    contact    : contact at the end of the last solve, with all pairs of the surface
    start      : (l, 3) [m] solution from which the next solve may start
    end        : contact at the end of an earlier solve, whose normal forces limit friction; None
                 for the forces at q
    """

    environment: Environment
    q: Positions
    y: Positions
    load: ExternalForces
    time: float
    time_step: float
    before: Indices | None
    fixed: Mask
    q_before: Positions | None = None

    def __post_init__(self) -> None:
        self.solves = 0
        self.is_settled = False
        self.contact: StepContactAt | None = None
        self.start: Positions | None = None
        self.end: StepContactAt | None = None
        self.sides = self._crossed(self.y)
        with CONTACT:
            self.environment.begin_contacts(self.q, self.time, self.time_step)

    def _crossed(self, end: Positions) -> Indices:
        """Return the sides (o, l) of nodes that move straight from q to ``end`` (l, 3) [m]."""
        with CONTACT:
            return self.environment.obstacles.contact_faces(
                self.q, end, self.time, self.time_step, self.before, self.fixed
            )

    def problem(self) -> StepProblem:
        """Return the problem of the step with the present contact faces."""
        environment, time = self.environment, self.time
        before, step = self.q_before, self.time_step
        contact = environment.contact(self.q, before, time, step, self.sides, self.end)
        prescribed = environment.anchors.prescribed(self.q, time)
        load, pressures = self.load.force, self.load.pressures.values
        return StepProblem(
            self.q, self.y, load, contact, prescribed,
            pressures=pressures, system_monitor=environment.system_monitor,
        )  # fmt: skip

    def solve(self, step: Callable[[StepProblem], StepResult]) -> StepResult:
        """Return the result of ``step`` with settled contacts. Raises StepFailed."""
        while not self.is_settled:
            result = step(self.problem())
            self.compare(result)
        return replace(result, contact=self.contact)

    def compare(self, result: StepResult) -> None:
        """Update the contacts from the result of the last solve.

        Raises StepFailed if the faces do not settle in MOST_SOLVES solves.
        """
        x = result.position
        crossed, pressing = self._crossed(x), self.environment.obstacles.pressing
        sides = np.where(self.sides > 0, self.sides, crossed) if self.solves else crossed
        self.solves += 1
        environment, obstacles = self.environment, self.environment.obstacles
        self.is_settled = not obstacles.has_sides or obstacles.same_push(
            x, self.time, self.sides, sides
        )
        if not self.is_settled:
            self.sides = sides
            if self.solves == MOST_SOLVES:
                raise StepFailed(
                    f"has nodes that pass through an obstacle after {MOST_SOLVES} solves, each "
                    "with the faces that they entered by; try a smaller time.step, or "
                    'safety.on_failure = "substep"',
                    "contact",
                )
            return
        with CONTACT:
            self.contact, self.is_settled, is_free = environment.settle_contacts(
                result.contact, x, result.energy_tolerance
            )
        if not self.is_settled:
            self.start = x if is_free else None
            return
        if self.end is None and environment.friction_lags(self.contact):
            self.end, self.start = self.contact, x
            self.is_settled = False
            environment.narrow_contacts()
            return
        # Reflecting obstacles use the faces crossed on the path to x.
        if obstacles.penalties:
            crossed[pressing] = np.where(sides > 0, sides, self.sides)[pressing]
        self.sides = crossed


class ImplicitEuler(Integrator):
    """Take steps by implicit Euler,

        v_(n+1) = v_n + t M^(-1) (f_ext - grad E(q_(n+1))),    q_(n+1) = q_n + t v_(n+1),

    with y = q_n + t v_n = 2 q_n - q_(n-1) and tau = t (Eq. 10-12). If an anchor ends, its nodes
    become unknowns, so a new solver is made.

    TAU_PER_STEP : tau / t
    STATIC       : whether F has no inertia
    """

    TAU_PER_STEP = 1.0
    STATIC = False
    state: ClassVar[dict[str, Range]] = {}

    def __init__(
        self, comm: MPI.Comm, environment: Environment, time: Time, solver: Solver, prefix: str
    ):
        self.comm, self.environment, self.solver, self.prefix = comm, environment, solver, prefix
        self.time_step = time.step
        self.damping, self.retardation = environment.damping, environment.retardation
        self.tau = self._first_tau()
        self.anchors = environment.anchors.acting(self.time_step)
        self.stepper = self._new_stepper(self.time_step)

    def _first_tau(self) -> float:
        """Return tau [s] without damping."""
        return self.TAU_PER_STEP * self.time_step

    @property
    def damped_tau(self) -> float:
        """Return tau [s] of the undamped problem equal to the damped problem."""
        return self.tau / float(np.sqrt(1 + self.damping * self.tau))

    def _carried_time(self, duration: float) -> float:
        """Return d / (1 + alpha d) [s], the time in which a velocity acts over a duration d [s]."""
        return duration / (1 + self.damping * duration)

    def _rates(
        self, problem: StepProblem, q_before: Positions | None
    ) -> tuple[Positions, Positions] | None:
        """Return x^ of a viscous solid and the positions that rotate its K, (l, 3) [m] each.

        Return None if the solid is not viscous.
        """
        if not self.retardation:
            return None
        q, fixed = problem.q, self.stepper.lattice.fixed
        # y lacks the motion that an anchor begins in this step
        end = np.where(fixed, problem.fixed_positions, problem.y)
        if q_before is None:
            return q, 0.5 * (q + end)
        return (4 * q - q_before) / 3, end

    def set_up(self) -> None:
        """Build the preconditioner (collective). Raises InputError if PETSc lacks it."""
        self.stepper.set_up()

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        self._let_go(time)
        q, time_step = state.q, self.time_step
        self.environment.forces.begin_step(q, state.velocity(time_step), time - time_step)
        y = 2 * q - state.q_previous
        if self.damping:
            carried = self._carried_time(time_step)
            y = q + carried / time_step * (q - state.q_previous)
        load = self.environment.forces.mean(time - time_step, time)
        result, sides = self._solve(state, y, load, time, time_step)
        after, before, work = self.environment.obstacles.strike(
            result.position,
            result.previous,
            StepTaken(time, time_step, sides),
            self.stepper.lattice.fixed,
        )
        return replace(result, work=work), State(after, before, sides=sides)

    def _solve(
        self,
        state: State,
        y: Positions,
        load: ExternalForces,
        time: float,
        time_step: float,
        q_before: Positions | None = None,
    ) -> tuple[StepResult, Indices]:
        """Return the solution of the step to ``time`` [s] and its contact faces (o, l).

        y        : (l, 3) positions without forces [m]
        load     : external forces
        q_before : (l, 3) positions one step before the state [m], for BDF2
        """
        fixed = self.stepper.lattice.pinned
        faces = ContactFaces(
            self.environment, state.q, y, load, time, time_step, state.sides, fixed, q_before
        )
        work_before = self.stepper.work_so_far()
        result = faces.solve(
            lambda whole: self.stepper.step(
                replace(whole, rates=self._rates(whole, q_before)), faces.start
            )
        )
        self.environment.end_step(result.contact)
        cost = replace(
            self.stepper.work_so_far() - work_before, steps=1, step_error=result.cost.step_error
        )
        result = replace(result, cost=cost, load=load, tau=self.damped_tau)
        return self._with_viscosity(result), faces.sides

    def _with_viscosity(self, result: StepResult) -> StepResult:
        """Return a step's result with the viscous forces and the decrease of D (StepResult)."""
        viscosity, problem = self.stepper.functional.elasticity.viscosity, result.problem
        if viscosity is None or problem is None:
            return result
        forces = np.zeros_like(result.position)
        viscosity.add_gradient(result.position, forces)
        taken = -viscosity.change(result.position, problem.fixed_positions)
        return replace(result, viscous=forces[: len(problem.load)], viscous_work=taken)

    def _new_stepper(self, time: float) -> Stepper:
        """Return a new solver for the nodes that are free at a time [s] (collective)."""
        solver = self.solver
        lattice = self.environment.lattice.pin(self.environment.anchors.fixed_at(time))
        if self.retardation:
            lattice = replace(lattice, viscous=self.retardation / self.tau)
        return Stepper(
            self.comm,
            lattice,
            self.damped_tau,
            find_preset(solver.preset),
            solver.error,
            solver.max_iterations,
            touches=self.environment.touches,
            prefix=self.prefix,
            static=self.STATIC,
            solid=self.environment.elasticity.solid,
        )

    def _let_go(self, time: float) -> bool:
        """Make a new solver if an anchor has ended by ``time`` [s]; return whether (collective)."""
        anchors = self.environment.anchors.acting(time)
        has_ended = len(anchors) < len(self.anchors)
        if has_ended:
            self.anchors = anchors
            # Begin with the first tau, because a resumed run does not know the old tau.
            self._renew(self._first_tau(), time)
        return has_ended

    def _renew(self, tau: float, time: float) -> None:
        """Make a new solver for a tau [s] and the nodes free at a time [s] (collective)."""
        self.destroy()
        self.tau = tau
        self.stepper = self._new_stepper(time)
        self.set_up()

    def save(self, checkpoint: Checkpoint) -> None:
        # Before the first step the solver has nothing to forget.
        if checkpoint.step:
            self.stepper.forget(modes=False)
        checkpoint.keep_counts(self)
        self.stepper.optimality.curvature.save(checkpoint)

    def restore(self, checkpoint: Checkpoint, time: float) -> None:
        self._let_go(time)
        self.stepper.forget()
        checkpoint.restore_counts(self)
        self.stepper.optimality.curvature.restore(checkpoint)

    def destroy(self) -> None:
        self.stepper.destroy()
