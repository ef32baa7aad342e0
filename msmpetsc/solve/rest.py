"""Rest: when a run in motion may end, for nothing would move any more (time.until = "rest").

A standstill is no rest: a swing stands still where it turns, under forces that do not balance; and forces balance where
it is fastest. So two lengths must be small, in the norm of M, relative to the farthest the body was from its start:
how far it is from the equilibrium near by, and how far its velocity would carry it from there,

    |e|_M,  H e = T^2 (grad E(q) - f_ext),    and    sqrt(v^T M w),  H w = T^2 M v,    H = M + T^2 (Hessian of E).

T is all of the run's time: so of a swing of frequency omega the second is its amplitude |v| / omega, and of a body
that nothing holds the way |v| T. They are estimated as errors of steps are, once a step has moved little.
"""

from typing import ClassVar

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Rows
from msmpetsc.build import Model
from msmpetsc.checkpoint import COUNT, LENGTH, Range
from msmpetsc.comm import log
from msmpetsc.environment import Environment
from msmpetsc.scene.reading import Scene
from msmpetsc.solve.integrators.integrator import State
from msmpetsc.solve.nonlinear.error_control import DEFAULT_ERROR
from msmpetsc.solve.nonlinear.functional import Iterate, StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.presets import find_preset

PRESET, PREFIX = "newton-multigrid", "rest_"
LONGEST_WAIT = 8  # steps between two looks
LEAST = 1e-10  # of a cell: what a body moves less than that is rounding


class Rest:
    """Check after each step whether the body has come to rest. All methods are collective.

    has_come : whether it has
    """

    state: ClassVar[dict[str, Range]] = {
        "farthest": LENGTH,
        "next": COUNT,
        "wait": (1, LONGEST_WAIT),
        "has_come": (0, 1),
    }

    def __init__(self, comm: MPI.Comm, scene: Scene, model: Model, environment: Environment):
        self.comm, self.model, self.environment = comm, model, environment
        self.time_step, self.duration = scene.time.step, scene.time.duration
        self.error = scene.solver.error or DEFAULT_ERROR
        self.last_change = environment.last_change(scene.time.duration)
        self.farthest = 0.0  # from the start [m sqrt(kg)]
        self.least = LEAST * model.lattice.cell_size * np.sqrt(comm.allreduce(float(model.lattice.mass.sum())))
        self.next, self.wait = 0, 1  # step to look at next, steps until the one after that
        self.has_come = False

    def look(self, index: int, time: float, before: State, after: State) -> bool:
        """Whether the body is at rest after step ``index``, which ended at ``time`` [s]."""
        self.farthest = max(self.farthest, self._norm(after.q - self.model.start[0]))
        limit = max(self.error * self.farthest, self.least)
        moved = max(self._norm(after.q - before.q), self._norm(after.q - after.q_previous))
        if time < self.last_change or index < self.next or moved > limit:
            return False
        self.has_come = self._is_at_rest(after, time, limit)
        self.next, self.wait = index + self.wait, min(2 * self.wait, LONGEST_WAIT)
        if self.has_come:
            log.info(
                "at rest after step %d (t = %.6g s): nothing would move by more than %.2g of the farthest it was",
                index, time, self.error,
            )  # fmt: skip
        return self.has_come

    def _norm(self, moved: Rows) -> float:
        """|v|_M of displacements (l, 3) [m]."""
        own = moved[: self.model.lattice.owned]
        return float(np.sqrt(self.comm.allreduce(float(self.model.lattice.mass @ (own**2).sum(axis=1)))))

    def _is_at_rest(self, state: State, time: float, limit: float) -> bool:
        lattice, touches = self.model.lattice.pin(self.environment.fixed_at(time)), self.environment.touches
        preset = find_preset(PRESET)
        stepper = Stepper(self.comm, lattice, self.duration, preset, self.error, touches=touches, prefix=PREFIX)
        try:
            contact = self.environment.contact(state.q, state.q, time, self.time_step, state.sides, None)
            stepper.functional.begin(StepProblem(state.q, state.q, self.environment.load(time), contact))
            functional, estimate, f = stepper.functional, stepper.control.estimate, stepper.work
            stepper.unknowns.from_nodes(state.q, stepper.x)
            iterate = functional.evaluate(stepper.x, f)
            if not estimate(iterate, functional.dual_norm(f), limit) <= limit:
                return False
            stepper.unknowns.from_nodes(state.velocity(self.time_step), f)
            functional.memory.write(f)[:] *= functional.t2 * functional.mass
            if not np.isfinite(estimate(Iterate(state.q, f), functional.dual_norm(f), np.inf)):
                return False
            return bool(np.sqrt(max(estimate.correction.dot(f), 0.0) / functional.t2) <= limit)
        finally:
            stepper.destroy()
