"""Statics: each step of the scene is a state of equilibrium under what acts at its end, without inertia.

It is a minimum of  E(x) - x^T f_ext  and of what obstacles add, as an implicit step is without M: so the solver is
that of a step, its F

    F(x) = tau^2 (grad E(x) - f_ext).

M only weighs errors. tau scales F, so that M^(-1) tau^2 (Hessian of E) has no eigenvalue below about 1 where the body
is at rest: as a step's Hessian has none for its M, from which bounds on errors follow.

Where the whole load cannot be brought on at once it comes on in load steps (solve.integrators.load_steps).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from mpi4py import MPI

from msmpetsc.checkpoint import ANY, Checkpoint, Range
from msmpetsc.comm import log
from msmpetsc.errors import StepFailed
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.solve.integrators.implicit import ImplicitEuler
from msmpetsc.solve.integrators.load_steps import LoadPath, LoadSteps
from msmpetsc.solve.integrators.state import State
from msmpetsc.solve.integrators.support import refuse_free_bodies
from msmpetsc.solve.nonlinear.curvature import NONE, Alarm
from msmpetsc.solve.nonlinear.step import Stepper, StepResult
from msmpetsc.solve.work import Work

SLENDER = 10.0  # times as slow as sound passes the body: where tau is looked for first
LOWEST = 10.0  # eigenvalue of M^(-1) tau^2 (Hessian of E) at rest
WILL_DO = 1.0, 1e3  # eigenvalues for which no other tau is taken, for that takes another solver
SOON = 30  # iterations of a load step that may still be halved


class Static(ImplicitEuler):
    """States of equilibrium (an Integrator): that at ``time``, from the one a step before.

    Forces, anchors and obstacles are taken as they are then.

    error    : of the last state
    made_for : time [s] whose nodes the stepper has for its unknowns
    """

    STATIC = True

    def __init__(self, *arguments, **settings):
        self.error = self.made_for = 0.0
        super().__init__(*arguments, **settings)

    def _first_tau(self) -> float:
        return SLENDER * transit_time(self.comm, self.model.lattice)

    def _new_stepper(self, time: float) -> Stepper:
        self.made_for = time
        return super()._new_stepper(time)

    def set_up(self) -> None:
        """Make ready, and settle tau. Raises InputError for a body that is not held."""
        refuse_free_bodies(self.comm, self.stepper.unknowns)
        self.stepper.set_up()
        lowest = self._lowest()
        if lowest > 0 and not WILL_DO[0] <= lowest <= WILL_DO[1]:
            self.tau *= float(np.sqrt(LOWEST / lowest))
            self.stepper.destroy()
            self.stepper = self._new_stepper(self.made_for)
            self.stepper.set_up()

    def _lowest(self) -> float:
        """The lowest eigenvalue of M^(-1) tau^2 (Hessian of E) of the body at rest, roughly (collective)."""
        minimum, rest = self.stepper.minimum, self.stepper.lattice.nodes
        minimum.estimate.linearise(rest)
        return minimum.curvature.lowest(rest, NONE, Alarm.NOWHERE, None)[0]

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        self._let_go(time)
        before = time - self.time_step
        if before > 0.5 * self.time_step and self.environment.is_same(before, time):
            return StepResult(state.q, state.q, Work(self.error, steps=1), static=True), state
        stepper = self.stepper
        begun = stepper.work_so_far()
        path = LoadPath(self.comm, stepper, self.environment, state, time, self.time_step)
        result = self._follow(path, time)
        q, self.problem, self.error = result.position, path.problem, result.cost.step_error
        cost = replace(stepper.work_so_far() - begun, steps=1, step_error=self.error)
        result = replace(result, previous=q, cost=cost, static=True)
        return result, State(q, q, sides=path.sides)

    def _follow(self, path: LoadPath, time: float) -> StepResult:
        """Bring all of the load on, with as few load steps as may be. Raises StepFailed."""
        steps = LoadSteps()
        while not steps.is_done:
            try:
                with self._hurried(steps.may_be_refused):
                    result = path.try_share(steps)
                steps.take()
            except StepFailed as failure:
                steps.halve(failure)
        if steps.count > 1:
            log.info("t = %.6g s: the load came on in %d steps", time, steps.count)
        return result

    @property
    def state(self) -> dict[str, Range]:
        return {"error": ANY}

    def save(self, checkpoint: Checkpoint) -> None:
        super().save(checkpoint)
        checkpoint.keep_counts(self)

    def restore(self, checkpoint: Checkpoint, time: float) -> None:
        super().restore(checkpoint, time)
        checkpoint.restore_counts(self)

    @contextmanager
    def _hurried(self, soon: bool) -> Iterator[None]:
        """Give up ``soon``, after a few iterations, unless the user has said after how many."""
        snes, most = self.stepper.snes, self.stepper.snes.getTolerances()[3]
        if soon and not self.stepper.budget and self.stepper.options.is_default("snes_max_it"):
            snes.setTolerances(max_it=SOON)
        try:
            yield
        finally:
            snes.setTolerances(max_it=most)


def transit_time(comm: MPI.Comm, lattice: Lattice) -> float:
    """How long sound takes along the longest side of a lattice, roughly [s] (collective)."""
    low, high = lattice.nodes.min(axis=0), lattice.nodes.max(axis=0)
    low, high = (np.array(comm.allgather([float(x) for x in corner])) for corner in (low, high))
    cells = (high.max(axis=0) - low.min(axis=0)).max() / lattice.cell_size
    sums = np.array([float(lattice.mass.sum()), float(lattice.stiffness[: lattice.springs_owned].sum())])
    mass, stiffness = comm.allreduce(sums)
    return float(cells * np.sqrt(mass / max(stiffness, np.finfo(float).tiny)))
