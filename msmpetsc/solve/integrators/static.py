"""Statics: each step of the scene is an equilibrium under what acts at its end, without inertia.

It is a minimum of  E(x) - x^T f_ext  and of what obstacles add, as an implicit step is without M: so the solver is
that of a step, its F

    F(x) = tau^2 (grad E(x) - f_ext).

M only weighs errors. tau scales F, so that M^(-1) tau^2 (Hessian of E) has no eigenvalue below about 1 where the body
is at rest: as a step's Hessian has none for its M, from which bounds on errors follow.

Where the whole load cannot be brought on at once it comes on in load steps. A share s of it, 0 to 1, is the
equilibrium under  f_ext + (1 - s) r,  r = grad E(x_0) - f_ext  what keeps the state before, x_0, where it is.
A start is no equilibrium: where the whole load fails from there, or leaves folds, x_0 is the rest shape.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Positions, Rows, to_host
from msmpetsc.checkpoint import ANY, Range
from msmpetsc.comm import log
from msmpetsc.elasticity.locate import of_body, worst_inverted
from msmpetsc.environment import Environment
from msmpetsc.errors import InputError, StepFailed
from msmpetsc.solve.integrators.implicit import ContactFaces, ImplicitEuler
from msmpetsc.solve.integrators.integrator import State
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.free_bodies import bodies_of
from msmpetsc.solve.nonlinear.curvature import NONE, Alarm
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper, StepResult
from msmpetsc.solve.work import Work

SLENDER = 10.0  # times as slow as sound passes the body: where tau is looked for first
LOWEST = 10.0  # eigenvalue of M^(-1) tau^2 (Hessian of E) at rest
WILL_DO = 1.0, 1e3  # eigenvalues for which no other tau is taken, for that takes another solver
SOON = 200  # iterations of a load step that may still be halved
SMALLEST = 2.0**-10  # of the load: the smallest load step
MOST_FAILURES = 50  # of the load steps of one state
SMALL = 2.0**-4  # of the load: a step no larger is not refused for what a smaller one may avoid


class LoadSteps:
    """Shares of a load that are tried one after another.

    reached : share of the equilibrium found last
    count   : load steps that were taken
    """

    def __init__(self) -> None:
        self.reached, self.size, self.count, self.failures = 0.0, 1.0, 0, 0

    @property
    def share(self) -> float:
        """The share to try next."""
        return min(self.reached + self.size, 1.0)

    @property
    def may_be_refused(self) -> bool:
        """Whether the next step is so large that smaller ones may well end better."""
        return self.size > SMALL

    def take(self) -> None:
        """Accept the share, which has its equilibrium: the next step is twice as large."""
        self.reached, self.size, self.count = self.share, 2 * self.size, self.count + 1

    def halve(self, failure: StepFailed) -> None:
        """Shorten the next step after a failure. Raises StepFailed after one of the smallest, or very many."""
        self.size, self.failures = 0.5 * (self.share - self.reached), self.failures + 1
        if self.size < SMALLEST or self.failures > MOST_FAILURES:
            raise StepFailed(
                f"{failure} (and failed with {2 * self.size:.1g} of the load)", failure.kind
            ) from None


@dataclass
class LoadPath:
    """Equilibria between a state and the next one. All methods are collective.

    problem    : of the share taken last
    sides      : (o, l) contact faces that it has
    displaced  : whether the state before is a start, and not the rest shape
    """

    stepper: Stepper
    environment: Environment
    state: State
    time: float
    time_step: float

    def __post_init__(self) -> None:
        self.base = self.state.q
        self.target = self.environment.anchors.prescribed(self.base, self.time)
        self.known = [(0.0, self.base)]  # shares and their positions (l, 3) [m], the last two
        self.sides = self.state.sides
        first, lattice = self.time < 1.5 * self.time_step, self.stepper.lattice
        at_rest = self.stepper.comm.allreduce(bool((self.base == lattice.nodes).all()), MPI.LAND)
        self.displaced = first and not at_rest
        self.inverted = 0 if first else worst_inverted(self.stepper.comm, lattice, self.base)[0]
        self.holding: Rows | None = (
            None  # r (owned, 3) [N], which keeps free nodes where they are; once asked for
        )
        self.problem: StepProblem | None = None

    def try_share(self, steps: LoadSteps) -> StepResult:
        """Find the equilibrium of the share to try. Raises StepFailed where there is none, or one
        with cells turned inside out, which smaller steps may avoid."""
        share = steps.share
        q = self.known[-1][1]
        time_step = (
            0.0 if len(self.known) > 1 else self.time_step
        )  # obstacles move in the first load step alone
        fixed = self.stepper.lattice.pinned
        faces = ContactFaces(self.environment, q, q, self.time, time_step, self.sides, fixed)
        result = faces.solve(lambda whole: self._step(self._problem(whole, share), share))
        lattice = self.stepper.lattice
        count, where = worst_inverted(
            self.stepper.comm, lattice, result.position, corners=self.displaced
        )
        if steps.may_be_refused and count > self.inverted:
            raise StepFailed(
                f"turned {count - self.inverted} cells inside out, the worst {where}", "inverted"
            )
        self.known = [self.known[-1], (share, result.position)]
        self.problem, self.sides = result.problem, faces.sides
        return result

    def _step(self, problem: StepProblem, share: float) -> StepResult:
        return self.stepper.step(problem, self._guess(problem, share))

    def _problem(self, whole: StepProblem, share: float) -> StepProblem:
        load, prescribed = whole.load, self.target
        if share < 1:
            if self.holding is None:
                stepper, functional, lattice = (
                    self.stepper,
                    self.stepper.functional,
                    self.stepper.lattice,
                )
                functional.begin(replace(whole, y=self.base, prescribed=None))
                held = functional.at(self.base)
                self.holding = np.zeros((lattice.owned, 3), like=lattice.nodes)
                self.holding[stepper.unknowns.free] = (
                    stepper.unknowns.columns(held.f).T / functional.t2
                )
            load = load + (1 - share) * self.holding
            prescribed = self.environment.anchors.prescribed(
                self.base, self.time, self.time - self.time_step, share
            )
        return replace(whole, y=self.base, load=load, prescribed=prescribed)

    def _guess(self, problem: StepProblem, share: float) -> Positions:
        """Positions (l, 3) [m] to start from: the last ones, or the line through the last two gone on, by their g."""
        (share_before, before), (reached, q) = self.known[0], self.known[-1]
        if reached == share_before:
            return q
        functional = self.stepper.functional
        pinned = self.stepper.lattice.pinned[:, None]
        ahead = q + (share - reached) / (reached - share_before) * (q - before)
        functional.begin(problem)
        values = [functional.value(np.where(pinned, problem.fixed, guess)) for guess in (q, ahead)]
        return ahead if values[1] < values[0] else q


class Static(ImplicitEuler):
    """States of equilibrium at the times of steps: that at ``time``, from the one a step before.

    Forces, anchors and obstacles are taken as they are then.

    error : of the last state
    """

    STATIC = True
    state: ClassVar[dict[str, Range]] = {"error": ANY}
    error = 0.0
    problem: StepProblem | None = None  # of the last state

    def _first_tau(self) -> float:
        """SLENDER times how long sound takes along the longest side of the lattice, roughly [s]."""
        lattice = self.environment.lattice
        low, high = lattice.nodes.min(axis=0), lattice.nodes.max(axis=0)
        low, high = (
            np.array(self.comm.allgather([float(x) for x in corner])) for corner in (low, high)
        )
        cells = (high.max(axis=0) - low.min(axis=0)).max() / lattice.cell_size
        sums = np.array(
            [float(lattice.mass.sum()), float(lattice.stiffness[: lattice.springs_owned].sum())]
        )
        mass, stiffness = self.comm.allreduce(sums)
        return SLENDER * float(cells * np.sqrt(mass / max(stiffness, np.finfo(float).tiny)))

    def set_up(self) -> None:
        """Make ready, and settle tau. Raises InputError for a body that is not held."""
        refuse_free_bodies(self.stepper.unknowns)
        self.stepper.set_up()
        minimum, rest = self.stepper.minimum, self.stepper.lattice.nodes
        minimum.estimate.linearise(rest)
        lowest = minimum.curvature.lowest(rest, NONE, Alarm.NOWHERE, None)[
            0
        ]  # of M^(-1) tau^2 (Hessian of E), roughly
        if lowest > 0 and not WILL_DO[0] <= lowest <= WILL_DO[1]:
            self.tau *= float(np.sqrt(LOWEST / lowest))
            self.stepper.destroy()
            self.stepper = replace(self.stepper, time_step=self.damped_tau)
            self.stepper.set_up()

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        self._let_go(time)
        before = time - self.time_step
        if before > 0.5 * self.time_step and self.environment.is_same(before, time):
            return StepResult(
                state.q, state.q, Work(self.error, steps=1), static=True, problem=self.problem
            ), state
        stepper = self.stepper
        begun = stepper.work_so_far()
        path = LoadPath(stepper, self.environment, state, time, self.time_step)
        result, path = self._follow(path)
        q, self.problem, self.error = result.position, path.problem, result.cost.step_error
        cost = replace(stepper.work_so_far() - begun, steps=1, step_error=self.error)
        result = replace(result, previous=q, cost=cost, static=True, problem=self.problem)
        return result, State(q, q, sides=path.sides)

    def _follow(self, path: LoadPath) -> tuple[StepResult, LoadPath]:
        """Bring all of the load on in few load steps; return their path, too. Raises StepFailed."""
        steps, snes, rest = LoadSteps(), self.stepper.snes, self.stepper.lattice.nodes
        most = snes.getTolerances()[3]
        hurries = not self.stepper.budget and self.stepper.options.is_default(
            "snes_max_it"
        )  # else the user has said
        try:
            while steps.reached < 1.0:
                if hurries:
                    snes.setTolerances(max_it=SOON if steps.may_be_refused else most)
                try:
                    result = path.try_share(steps)
                    steps.take()
                except StepFailed as failure:
                    if not path.displaced:
                        steps.halve(failure)
                        continue
                    reason = str(failure).split("; try ")[0]
                    log.info("t = %.6g s: begun at the rest shape: it %s", path.time, reason)
                    path = replace(path, state=State(rest, rest))
        finally:
            snes.setTolerances(max_it=most)
        if steps.count > 1:
            log.info("t = %.6g s: the load came on in %d steps", path.time, steps.count)
        return result, path


def refuse_free_bodies(unknowns: Unknowns) -> None:
    """Raise InputError for a body, or a part of one that no spring joins with the rest, that
    nothing holds, and where no more than two nodes are held (collective)."""
    bodies, lattice = bodies_of(unknowns), unknowns.lattice
    held = "held at a point or two, about which it turns"
    if bodies.free.any():
        held = "held by nothing"
    elif lattice.table.total - unknowns.total > 2:
        return
    what = "the body"
    if len(bodies.free) > 1:
        number = int(np.argmax(bodies.free))
        rows = np.flatnonzero(bodies.number[: lattice.owned] == number)
        own = to_host(lattice.nodes[: lattice.owned])[rows]
        sums = unknowns.comm.allreduce(np.append(own.sum(axis=0), len(own)))
        first = unknowns.comm.allreduce(
            int(rows.min(initial=lattice.owned)) + lattice.table.first, MPI.MIN
        )
        place = ", ".join(f"{x:.4g}" for x in sums[:3] / sums[3])
        what = f"a part {of_body(lattice, first)}of {int(sums[3])} nodes about ({place}) m at rest"
    raise InputError(
        f'time.integrator = "static": {what} is {held}: it has no equilibrium without inertia; pin it or lead it by an '
        "anchor (contact does not count), or choose another integrator"
    )
