"""Load steps: a load is brought on in parts where it cannot be brought on at once.

A share s of it, 0 to 1, is the equilibrium under  f_ext + (1 - s) r,  r = grad E(x_0) - f_ext  what keeps the state
before, x_0, where it is; obstacles press as they will, and anchors have gone a share s of their way. So it does not
matter what has changed: a force, an anchor that lets go, an obstacle.
"""

from dataclasses import replace

import numpy as np
from mpi4py import MPI

from msmpetsc.elasticity.locate import worst_inverted
from msmpetsc.environment import Environment
from msmpetsc.errors import StepFailed
from msmpetsc.solve.integrators.contact_faces import ContactFaces
from msmpetsc.solve.integrators.state import State
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper, StepResult

SMALLEST = 2.0**-10  # of the load
MOST_FAILURES = 50  # of the load steps of one state
SMALL = 2.0**-4  # of it: not refused any more for what a smaller one may avoid


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
    def is_done(self) -> bool:
        return self.reached == 1.0

    @property
    def may_be_refused(self) -> bool:
        """Whether the next step is so large that smaller ones may well end better."""
        return self.size > SMALL

    def take(self) -> None:
        """Know that the share has its equilibrium: the next step is twice as large."""
        self.reached, self.size, self.count = self.share, 2 * self.size, self.count + 1

    def halve(self, failure: StepFailed) -> None:
        """Know that the share failed. Raises StepFailed where it was of the smallest, or one of very many."""
        self.size, self.failures = 0.5 * (self.share - self.reached), self.failures + 1
        if self.size < SMALLEST or self.failures > MOST_FAILURES:
            raise StepFailed(f"{failure} (and failed with {2 * self.size:.1g} of the load)", failure.kind) from None


class LoadPath:
    """Equilibria between a state and the next one. All methods are collective.

    problem    : of the share taken last
    sides      : (o, l) contact faces that it has
    """

    def __init__(
        self,
        comm: MPI.Comm,
        stepper: Stepper,
        environment: Environment,
        state: State,
        time: float,
        time_step: float,
    ):
        self.comm, self.stepper, self.environment, self.time, self.time_step = (
            comm, stepper, environment, time, time_step
        )  # fmt: skip
        self.base, self.target = state.q, environment.prescribed(state.q, time)
        self.known = [(0.0, state.q)]  # shares and their positions (l, 3) [m], the last two
        self.sides = state.sides
        self.inverted = worst_inverted(comm, stepper.lattice, state.q)[0]
        self.holding: np.ndarray | None = None  # r (owned, 3) [N], once it is asked for
        self.problem: StepProblem | None = None

    def try_share(self, steps: LoadSteps) -> StepResult:
        """Find the equilibrium of the share to try. Raises StepFailed where there is none, or one with cells turned
        inside out, which smaller steps may avoid."""
        share, q = steps.share, self.known[-1][1]
        begun = len(self.known) > 1  # obstacles have moved
        faces = ContactFaces(
            self.comm,
            self.environment,
            q,
            q,
            time=self.time,
            time_step=0.0 if begun else self.time_step,
            before=self.sides,
            fixed=self.stepper.lattice.pinned,
        )
        while not faces.is_settled:
            problem = self._problem(faces.problem(), share)
            result = self.stepper.step(problem, self._guess(problem, share))
            faces.compare(result.position)
        if steps.may_be_refused:
            self._refuse_folds(result.position)
        self.known = [self.known[-1], (share, result.position)]
        self.problem, self.sides = problem, faces.sides
        return result

    def _problem(self, whole: StepProblem, share: float) -> StepProblem:
        """A share of the problem of the whole load."""
        load, prescribed = whole.load, self.target
        if share < 1:
            if self.holding is None:
                self.holding = self._holding(whole)
            load = load + (1 - share) * self.holding
            prescribed = None if prescribed is None else self.base + share * (prescribed - self.base)
        return replace(whole, y=self.base, load=load, prescribed=prescribed)

    def _holding(self, whole: StepProblem) -> np.ndarray:
        """The force (owned, 3) [N] that would keep the free nodes where they are."""
        stepper, functional, lattice = self.stepper, self.stepper.functional, self.stepper.lattice
        functional.begin(replace(whole, y=self.base, prescribed=None))
        stepper.unknowns.from_nodes(self.base, stepper.x)
        f = functional.evaluate(stepper.x, stepper.work).f
        holding = np.zeros((lattice.owned, 3), like=lattice.nodes)
        holding[stepper.unknowns.free] = stepper.unknowns.columns(f).T / functional.t2
        return holding

    def _guess(self, problem: StepProblem, share: float) -> np.ndarray:
        """Positions (l, 3) [m] to start from: the last ones, or the line through the last two gone on, by their g."""
        (share_before, before), (reached, q) = self.known[0], self.known[-1]
        if reached == share_before:
            return q
        pinned, functional = self.stepper.lattice.pinned[:, None], self.stepper.functional
        ahead = q + (share - reached) / (reached - share_before) * (q - before)
        functional.begin(problem)
        values = [functional.value(np.where(pinned, problem.fixed, guess)) for guess in (q, ahead)]
        return ahead if values[1] < values[0] else q

    def _refuse_folds(self, q: np.ndarray) -> None:
        """Raise StepFailed where more cells are inside out at q (l, 3) [m] than before."""
        count, where = worst_inverted(self.comm, self.stepper.lattice, q)
        if count > self.inverted:
            raise StepFailed(f"turned {count - self.inverted} cells inside out, the worst {where}", "inverted")
