"""Implicit steps: a step of the scene is one minimisation, solved by a solver that knows which nodes are free.

Implicit Euler and BDF2 both look for the x where  M (x - y) + tau^2 (grad E(x) - f_ext) = 0;  they differ in y, what
x were without forces, and in tau, a share of the time step t.

Damping by the mass adds -alpha M v to the forces. With v = (x - c) / tau, the velocity that belongs
to x, and y = c + tau w

    M (x - c - tau w) + tau alpha M (x - c) + tau^2 (grad E(x) - f_ext) = 0,

which is the same problem after division by 1 + alpha tau: of y = c + tau w / (1 + alpha tau), and with
tau^2 / (1 + alpha tau) for tau^2. So a step costs as much, and what nothing else moves slows down by 1 + alpha tau.

A viscous solid has its dissipation over the step beside E (elasticity.viscosity), with x^ = c, so that v is that of x.
Euler's difference of two positions is that of the turn half way between; BDF2's is of the step's end.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Indices, Mask, Positions, Rows
from msmpetsc.checkpoint import Checkpoint, Range
from msmpetsc.contact.obstacles.penalty import Contact
from msmpetsc.contact.obstacles.reflection import StepTaken
from msmpetsc.environment import Environment
from msmpetsc.errors import StepFailed
from msmpetsc.scene.schema import Solver
from msmpetsc.scene.time import Time
from msmpetsc.solve.integrators.integrator import Integrator, State
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper, StepResult
from msmpetsc.solve.petsc.events import CONTACT
from msmpetsc.solve.presets import find_preset
from msmpetsc.solve.work import Work

MOST_SOLVES = 10  # of a step, for nodes that pass through a box
MOST_NARROW = 3  # solves of a step that are asked for the pairs around contacts alone
LEFT_OUT = 1e-4  # of the energy that the error allowed is worth: what stores less moves x by a hundredth of that


@dataclass
class ContactFaces:
    """Search for the faces by which nodes are pushed out of obstacles in one step. All methods are collective.

    They are settled before the step is solved, by the way to y. Where the way to x shows others,
    the step is solved again; from then on a node that has a face keeps it, so that this ends.

    The surface is asked about around its contacts alone where the step begins, if these are few; where there are none,
    not at all. Where the way to x or x shows others, the step is solved again: so all of it is looked at once, and not
    for each iterate.

    q, y       : (l, 3) [m], as a StepProblem has them
    q_before   : (l, 3) [m] one step before q, of a step that looks so far back
    sides      : (o, l) faces of the problem to solve; once settled, those of the step
    is_settled : the problem solved last was the right one
    """

    environment: Environment
    q: Positions
    y: Positions
    time: float  # of the step's end [s]
    time_step: float
    before: Indices | None  # (o, l) faces when it began (environment); None: the nearest
    fixed: Mask  # (l,) bool, nodes that are no unknowns
    q_before: Positions | None = None

    def __post_init__(self) -> None:
        self.solves = 0
        self.is_settled = False
        self.contact: Contact | None = None  # of the problem solved last
        self.start: Positions | None = None  # of an earlier solve, that the next one may begin with
        self.end: Positions | None = (
            None  # of a solve whose friction went by a push far from the one there
        )
        self.sides = self._crossed(self.y)
        with CONTACT:
            self.environment.begin_contacts(self.q, self.time, self.time_step)

    def _crossed(self, end: Positions) -> Indices:
        """Sides (o, l) of nodes that go straight from q to ``end`` (l, 3) [m]."""
        with CONTACT:
            obstacles, held = self.environment.obstacles, self.fixed
            return obstacles.contact_faces(
                self.q, end, self.time, self.time_step, self.before, held
            )

    def problem(self) -> StepProblem:
        """Return the problem of the step with the faces as they are known now."""
        environment, time = self.environment, self.time
        before, step = self.q_before, self.time_step
        self.contact = environment.contact(self.q, before, time, step, self.sides, self.end)
        led = environment.anchors.prescribed(self.q, time)
        return StepProblem(self.q, self.y, environment.forces.at(time), self.contact, led)

    def solve(self, step: Callable[[StepProblem], StepResult]) -> StepResult:
        """Return the solution by ``step`` of the problem with the right faces. Raises StepFailed."""
        contacts = self.environment.contacts
        while not self.is_settled:
            try:
                result = step(self.problem())
            except StepFailed:
                if not (contacts and contacts.is_narrow):
                    raise
                contacts.widen()
            else:
                self.compare(result.position, LEFT_OUT * result.energy_tolerance)
        return result

    def compare(self, x: Positions, left_out: float) -> None:
        """Update the faces from the solution x (l, 3) [m], at which pairs of the surface may be left out that store no
        more than ``left_out`` [J]. Raises StepFailed where none settle."""
        crossed, pressing = self._crossed(x), self.environment.obstacles.pressing
        sides = np.where(self.sides > 0, self.sides, crossed) if self.solves else crossed
        self.solves += 1
        environment, contacts = self.environment, self.environment.contacts
        obstacles = environment.obstacles
        self.is_settled = not obstacles.has_sides or obstacles.same_push(
            x, self.time, self.sides, sides
        )
        if not self.is_settled:
            self.sides = sides
            if self.solves == MOST_SOLVES:
                raise StepFailed(
                    f"has nodes that pass through an obstacle, solved {MOST_SOLVES} times with the face that each came "
                    'in by; try a smaller time.step, or safety.on_failure = "substep"',
                    "contact",
                )
            return
        narrow = contacts if contacts and contacts.is_narrow else None
        if narrow:
            with CONTACT:
                free, self.is_settled = narrow.after_way(self.q, x, left_out)
            if not self.is_settled:
                self.start = x if free else None
                if self.solves >= MOST_NARROW:
                    narrow.widen()
                return
        if self.end is None and environment.friction_lags(x, self.contact):
            self.end = self.start = x
            self.is_settled = False
            if narrow:
                narrow.narrow(x, self.time)
            return
        if obstacles.penalties:  # what reflects goes by the way to x alone
            crossed[pressing] = np.where(sides > 0, sides, self.sides)[pressing]
        self.sides = crossed


class ImplicitEuler(Integrator):
    """Implicit Euler's method; another solver takes over where an anchor lets go.

        v_(n+1) = v_n + t M^(-1) (f_ext - grad E(q_(n+1))),    q_(n+1) = q_n + t v_(n+1)

    so that y = q_n + t v_n = 2 q_n - q_(n-1) and tau = t (Eq. 10-12).
    """

    SHARE = 1.0  # tau / t
    STATIC = False  # M is no part of F
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
        return self.SHARE * self.time_step

    @property
    def damped_tau(self) -> float:
        """Tau of the damped problem [s]; that without damping where there is none."""
        return self.tau / float(np.sqrt(1 + self.damping * self.tau))

    def _rates(
        self, q: Positions, y: Positions, q_before: Positions | None
    ) -> tuple[Positions, Positions] | None:
        """Return what a viscous solid's rates are of: x^, and positions that have turned as the rates have."""
        if not self.retardation:
            return None
        return (q, 0.5 * (q + y)) if q_before is None else ((4 * q - q_before) / 3, y)

    def _carried(self, duration: float) -> float:
        """Return how far a velocity carries in a time step [s] under damping."""
        return duration / (1 + self.damping * duration)

    def set_up(self) -> None:
        """Build the preconditioner (collective). Raises InputError for one that is missing."""
        self.stepper.set_up()

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        self._let_go(time)
        q, time_step = state.q, self.time_step
        self.environment.forces.begin_step(q, state.velocity(time_step), time - time_step)
        y = 2 * q - state.q_previous
        if self.damping:
            y = q + self._carried(time_step) / time_step * (q - state.q_previous)
        result, sides = self._solve(state, y, time, time_step)
        after, before, work = self.environment.obstacles.strike(
            result.position,
            result.previous,
            StepTaken(time, time_step, sides),
            self.stepper.lattice.pinned,
        )
        return replace(result, work=work), State(after, before, sides=sides)

    def _solve(
        self,
        state: State,
        y: Positions,
        time: float,
        time_step: float,
        q_before: Positions | None = None,
    ) -> tuple[StepResult, Indices]:
        """Solve for the x that belongs to y at ``time``, and for its contact faces.

        q_before : (l, 3) [m] one step before the state, of a step that looks so far back
        """
        fixed = self.stepper.lattice.pinned
        faces = ContactFaces(
            self.environment, state.q, y, time, time_step, state.sides, fixed, q_before
        )
        begun, rates = self.stepper.work_so_far(), self._rates(state.q, y, q_before)
        result = faces.solve(
            lambda whole: self.stepper.step(replace(whole, rates=rates), faces.start)
        )
        self.environment.end_step(result.position, faces.contact)
        cost = replace(
            self.stepper.work_so_far() - begun, steps=1, step_error=result.cost.step_error
        )
        result = replace(result, cost=cost, tau=self.damped_tau)
        return self._with_viscosity(result), faces.sides

    def _with_viscosity(self, result: StepResult) -> StepResult:
        """Return a step's result with the forces of viscosity, and what these took in where anchors led on."""
        viscosity, problem = self.stepper.functional.elasticity.viscosity, result.problem
        if viscosity is None or problem is None:
            return result
        forces = np.zeros_like(result.position)
        viscosity.add_gradient(result.position, forces)
        taken = -viscosity.change(result.position, problem.fixed)
        return replace(result, viscous=forces[: len(problem.load)], viscous_work=taken)

    def _new_stepper(self, time: float) -> Stepper:
        """Make the solver for the nodes that are free at a time [s]."""
        solver, lattice = (
            self.solver,
            self.environment.lattice.pin(self.environment.anchors.fixed_at(time)),
        )
        if self.retardation:
            factor = self.retardation / self.tau
            lattice = replace(lattice, stiffness=(1 + factor) * lattice.stiffness, viscous=factor)
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
        )

    def _let_go(self, time: float) -> None:
        """Make another solver where an anchor's time has come (collective)."""
        anchors = self.environment.anchors.acting(time)
        if len(anchors) < len(self.anchors):
            self.anchors = anchors
            self.destroy()
            self.tau = self._first_tau()  # whatever came before: a resumed run has not seen it
            self.stepper = self._new_stepper(time)
            self.set_up()

    def save(self, checkpoint: Checkpoint) -> None:
        if checkpoint.step:  # before the first there is nothing to forget
            self.stepper.forget(modes=False)
        checkpoint.keep_counts(self)
        checkpoint.keep_counts(self.stepper.control.estimate)
        self.stepper.minimum.curvature.save(checkpoint)

    def restore(self, checkpoint: Checkpoint, time: float) -> None:
        self._let_go(time)
        self.stepper.forget()
        checkpoint.restore_counts(self)
        checkpoint.restore_counts(self.stepper.control.estimate)
        self.stepper.minimum.curvature.restore(checkpoint)

    def forget(self) -> None:
        self.stepper.forget()

    def destroy(self) -> None:
        self.stepper.destroy()


class Bdf2(ImplicitEuler):
    """The backward differentiation formula of second order, of q and of v:

        q_(n+1) = (4 q_n - q_(n-1)) / 3 + tau v_(n+1),    v_(n+1) = (4 v_n - v_(n-1)) / 3 + tau a_(n+1),    tau = 2/3 t

    (Hairer and Wanner, Solving Ordinary Differential Equations II, III.1), so that y = (4 q_n -
    q_(n-1)) / 3 + tau (4 v_n - v_(n-1)) / 3. Friction, too, is of what the last two states lead to.
    """

    SHARE = 2 / 3
    looks_back = True

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        """Take a step as implicit Euler does, but a node that bounces off stays where it is, and its history becomes
        what leads there with its new velocity and the acceleration that it has: without that, which its neighbours feel
        the other end of, a ball gained a fifth of its energy.
        """
        self._let_go(time)
        q, v, begun = state.q, state.velocity(self.time_step), Work()
        self.environment.forces.begin_step(q, v, time - self.time_step)
        history = state.history
        if history is None:
            history, begun = self._history(state, time)
        q_0, v_0 = history
        y = (4 * q - q_0 + self._carried(self.tau) * (4 * v - v_0)) / 3
        result, sides = self._solve(state, y, time, self.time_step, q_0)
        v_1 = (3 * result.position - 4 * q + q_0) / (2 * self.time_step)
        previous = result.position - self.time_step * v_1
        a = 0.5 * (3 * v_1 - 4 * v + v_0) * self.time_step  # times t^2
        _, before, work = self.environment.obstacles.strike(
            result.position,
            previous,
            StepTaken(time, self.time_step, sides),
            self.stepper.lattice.pinned,
        )
        cost = replace(begun + result.cost, step_error=result.cost.step_error, steps=1)
        result = replace(result, previous=previous, cost=cost, work=work)
        if before is not previous:
            struck = (before != previous).any(axis=1)[:, None]
            v_after = (result.position - before - a) / self.time_step
            q, v = np.where(struck, before + 0.5 * a, q), np.where(struck, v_after, v)
        return result, State(result.position, before, (q, v), sides)

    def _history(self, state: State, time: float) -> tuple[tuple[Positions, Rows], Work]:
        """History that would have led to q and v with the acceleration of an implicit Euler step of tau from there,
        which is the true one but for a part of first order; the work that this takes."""
        t, tau, q, v = self.time_step, self.tau, state.q, state.velocity(self.time_step)
        result, _ = self._solve(state, q + self._carried(tau) * v, time - t + tau, tau)
        a = ((result.position - q) / tau - v) / tau
        return (q - t * v + t**2 / 2 * a, v - t * a), result.cost
