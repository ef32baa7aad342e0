"""Statics: each step of the scene is an equilibrium under the loads at its end, without inertia.

An equilibrium minimises E(x) - x^T f_ext plus the contact energy. This is the problem of an
implicit step without M, so the same solver applies, with the residual

    F(x) = tau^2 (grad E(x) - f_ext).

M only weights errors. tau scales F so that M^(-1) tau^2 (Hessian of E) of the body at rest has no
eigenvalue far below 1. Error bounds of implicit steps rely on the same property.

If the solve with the whole load fails or turns cells inside out, which springs cannot turn back,
the load is applied in load steps. The load of share s, from 0 to 1, is f_ext + (1 - s) r. The
holding force r = grad E(x_0) - f_ext keeps the last state, x_0, in place. A start that the scene
gives is no equilibrium. If a solve from this start fails or leaves folds, x_0 is the rest shape.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Mask, Rows, to_host
from msmpetsc.checkpoint import ANY, Range
from msmpetsc.comm import log, reduced
from msmpetsc.elasticity.locate import of_body, worst_inverted
from msmpetsc.environment import Environment
from msmpetsc.errors import InputError, StepFailed
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.solve.integrators.implicit import ContactFaces, ImplicitEuler
from msmpetsc.solve.integrators.integrator import State
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.free_bodies import bodies_of
from msmpetsc.solve.nonlinear.curvature import NONE, Alarm
from msmpetsc.solve.nonlinear.functional import Configuration, StepProblem
from msmpetsc.solve.nonlinear.step import Stepper, StepResult
from msmpetsc.solve.petsc.library import petsc_errors
from msmpetsc.solve.recovery import Halving
from msmpetsc.solve.work import Work

# first tau [travel time of sound along the body]; slender bodies oscillate more slowly
SLENDER = 10.0
# lowest eigenvalue of M^(-1) tau^2 (Hessian of E) that a new tau aims at [-]; 1 with a
# margin
LOWEST = 10.0
# range of the lowest eigenvalue in which tau stays [-]; another tau needs a new solver
ACCEPTED_LOWEST = 1.0, 1e3
# number of halvings of a load step beyond which smaller steps hardly help
SMALL = 4


@dataclass
class LoadPath:
    """Equilibria on the path from a state to the next state. All methods are collective.

    base      : (l, 3) positions x_0 of the last state [m]
    target    : (l, 3) prescribed positions at the whole load [m]; None without anchors
    reached   : (l, 3) positions of the last equilibrium [m]
    sides     : (o, l) contact faces of the last share
    displaced : whether the last state is an initial state other than the rest shape
    inverted  : number of inverted cells in the last state; 0 for an initial state
    holding   : holding force r (owned, 3) [N]; None until a share needs the force
    """

    stepper: Stepper
    environment: Environment
    state: State
    time: float
    time_step: float

    def __post_init__(self) -> None:
        self.base = self.state.q
        self.target = self.environment.anchors.prescribed(self.base, self.time)
        self.reached = self.base
        self.sides = self.state.sides
        first, lattice = self.time < 1.5 * self.time_step, self.stepper.lattice
        at_rest = reduced(self.stepper.comm, bool((self.base == lattice.nodes).all()), MPI.LAND)
        self.displaced = first and not at_rest
        self.inverted = 0 if first else worst_inverted(self.stepper.comm, lattice, self.base)[0]
        self.holding: Rows | None = None

    def try_share(self, steps: Halving) -> StepResult:
        """Return the equilibrium of the next share, ``steps.end``.

        Raises StepFailed if the solve fails, or if smaller load steps may avoid inverted cells.
        """
        share, q = steps.end, self.reached
        # Obstacles move in the first load step only.
        time_step = 0.0 if steps.count else self.time_step
        fixed = self.stepper.lattice.pinned
        load = self.environment.forces.at(self.time)
        faces = ContactFaces(self.environment, q, q, load, self.time, time_step, self.sides, fixed)
        result = faces.solve(lambda whole: self.stepper.step(self._problem(whole, share), q))
        lattice = self.stepper.lattice
        count, where = worst_inverted(
            self.stepper.comm, lattice, result.position, corners=self.displaced
        )
        if steps.level < SMALL and count > self.inverted:
            raise StepFailed(
                f"turned {count - self.inverted} cells inside out, the worst {where}", "inverted"
            )
        self.reached, self.sides = result.position, faces.sides
        return result

    def _problem(self, whole: StepProblem, share: float) -> StepProblem:
        """Return the problem of a share of the load; ``whole`` is the problem of the whole load."""
        load, prescribed = whole.load, self.target
        if share < 1:
            if self.holding is None:
                stepper, lattice = self.stepper, self.stepper.lattice
                functional = stepper.functional
                functional.begin(replace(whole, y=self.base, prescribed=None))
                iterate = functional.at(self.base)
                self.holding = np.zeros((lattice.owned, 3), like=lattice.nodes)
                self.holding[stepper.unknowns.free] = (
                    stepper.unknowns.columns(iterate.f).T / functional.t2
                )
            load = load + (1 - share) * self.holding
            prescribed = self.environment.anchors.prescribed(
                self.base, self.time, self.time - self.time_step, share
            )
        return replace(whole, y=self.base, load=load, prescribed=prescribed)


class Static(ImplicitEuler):
    """Find the equilibrium at the end of each step, starting from the last equilibrium.

    Forces, anchors and obstacles are taken at the end of the step.

    error : estimated relative error of the last equilibrium
    last  : result of the last step; None before it
    """

    STATIC = True
    state: ClassVar[dict[str, Range]] = {"error": ANY}
    error = 0.0
    last: StepResult | None = None

    def _first_tau(self) -> float:
        """Return SLENDER times the travel time [s] of sound along the longest side (collective)."""
        return SLENDER * time_of_sound(self.environment.lattice)

    def set_up(self) -> None:
        """Choose tau and build the preconditioner.

        Raises InputError if a body is not held, or if PETSc cannot apply the preconditioner.
        """
        refuse_free_bodies(self.stepper.unknowns)
        self.stepper.set_up()
        optimality, rest = self.stepper.optimality, self.stepper.lattice.nodes
        with petsc_errors("PETSc cannot set up the solver", self.stepper):
            optimality.estimate.linearise(Configuration(rest, None))
            lowest, _ = optimality.curvature.lowest(rest, NONE, Alarm.NOWHERE, None)
        if lowest > 0 and not ACCEPTED_LOWEST[0] <= lowest <= ACCEPTED_LOWEST[1]:
            self.tau *= float(np.sqrt(LOWEST / lowest))
            self.stepper.destroy()
            self.stepper = replace(self.stepper, time_step=self.damped_tau)
            self.stepper.set_up()

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        self._let_go(time)
        before = time - self.time_step
        # If nothing that acts has changed, the last state is the equilibrium.
        if before > 0.5 * self.time_step and self.environment.is_same(before, time):
            last, cost = self.last, Work(self.error, steps=1)
            if last is None or last.position is not state.q:
                # The run was resumed, or another integrator has taken the last step.
                last = StepResult(state.q, state.q, Work(), static=True)
            return replace(last, cost=cost), state
        stepper = self.stepper
        work_before = stepper.work_so_far()
        path = LoadPath(stepper, self.environment, state, time, self.time_step)
        result, path = self._follow(path)
        q, self.error = result.position, result.cost.step_error
        cost = replace(stepper.work_so_far() - work_before, steps=1, step_error=self.error)
        self.last = replace(result, previous=q, cost=cost, static=True)
        return self.last, State(q, q, sides=path.sides)

    def _follow(self, path: LoadPath) -> tuple[StepResult, LoadPath]:
        """Apply the whole load in as few load steps as possible; return the result and its path.

        Raises StepFailed.
        """
        steps, rest = Halving(), self.stepper.lattice.nodes
        result = StepResult(path.base, path.base, Work())

        def take() -> None:
            nonlocal path, result
            try:
                result = path.try_share(steps)
            except StepFailed as failure:
                if not path.displaced:
                    raise
                reason = str(failure).split("; try ")[0]
                log.info("t = %.6g s: begun at the rest shape: it %s", path.time, reason)
                path = replace(path, state=State(rest, rest))
                result = path.try_share(steps)

        steps.run(take)
        if steps.count > 1:
            log.info("t = %.6g s: the load came on in %d steps", path.time, steps.count)
        return result, path


def rigid_motions_stopped(unknowns: Unknowns, fixed: Mask) -> int:
    """Return how many of six rigid motions fixed components (owned, 3) prevent (collective)."""
    lattice = unknowns.lattice
    node, component = np.nonzero(fixed)
    x = to_host(lattice.nodes)[node] / lattice.cell_size
    total = reduced(unknowns.comm, np.append(x.sum(axis=0), len(x)))
    x -= total[:3] / max(total[3], 1.0)
    # rotations about each axis, along the component
    turns = np.cross(np.eye(3), x[:, None])[np.arange(len(node)), :, component]
    motions = np.hstack([np.eye(3)[component], turns])
    return int(np.linalg.matrix_rank(reduced(unknowns.comm, motions.T @ motions)))


def time_of_sound(lattice: Lattice) -> float:
    """Return about the travel time [s] of sound along the longest side (collective)."""
    if lattice.solid is None:
        stiffness = float(lattice.stiffness[: lattice.springs_owned].sum())
    else:
        bounds = lattice.solid.bounds[: lattice.cells_owned]
        stiffness = float(4 / 3 * bounds.sum() / lattice.cell_size**2)
    mass, stiffness = reduced(lattice.table.comm, [float(lattice.mass.sum()), stiffness])
    cells = lattice.longest_side() / lattice.cell_size
    return cells * float(np.sqrt(mass / max(stiffness, np.finfo(float).tiny)))


def refuse_free_bodies(unknowns: Unknowns) -> None:
    """Raise InputError if a body can move as a whole, freely or about a line (collective).

    A part that no spring or cell joins with the rest counts as a body.
    """
    bodies, lattice = bodies_of(unknowns), unknowns.lattice
    support = "held at a point or on a line, about which it turns"
    free = bodies.free.any(axis=1)
    fixed = to_host(lattice.fixed[: lattice.owned])
    if reduced(unknowns.comm, int(fixed.sum())) > 6:
        # many rollers may leave a rotation free; only nodes on a line are refused
        fixed = np.repeat(fixed.any(axis=1)[:, None], 3, axis=1)
    if free.any():
        along = [axis for axis, moves in zip("xyz", bodies.free[free][0], strict=True) if moves]
        support = f"held by nothing along {', '.join(along)}"
    elif rigid_motions_stopped(unknowns, fixed) == 6:
        return
    subject = "the body"
    if len(bodies.free) > 1:
        number = int(np.argmax(free))
        rows = np.flatnonzero(bodies.number[: lattice.owned] == number)
        own = to_host(lattice.nodes[: lattice.owned])[rows]
        sums = reduced(unknowns.comm, np.append(own.sum(axis=0), len(own)))
        first = reduced(
            unknowns.comm, int(rows.min(initial=lattice.owned)) + lattice.table.first, MPI.MIN
        )
        place = ", ".join(f"{x:.4g}" for x in sums[:3] / sums[3])
        nodes = f"{int(sums[3])} nodes about ({place}) m at rest"
        subject = f"a part {of_body(lattice, first)}of {nodes}"
    raise InputError(
        f'time.integrator = "static": {subject} is {support}: it has no equilibrium without '
        "inertia; pin it or lead it by an anchor (contact does not count), or choose another "
        "integrator"
    )
