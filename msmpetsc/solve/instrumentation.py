"""Monitors of a run, true errors of its steps, and times of its events.

Monitors warn of inverted cells, steps far from their solution, spurious energy, and nodes inside an
obstacle that begins to act.
"""

from dataclasses import replace
from typing import ClassVar

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Positions
from msmpetsc.checkpoint import ANY, COUNT, Range
from msmpetsc.comm import log, reduced
from msmpetsc.contact.obstacles.moving_solid import describe_overlap
from msmpetsc.elasticity.locate import worst_inverted
from msmpetsc.environment import Environment
from msmpetsc.errors import StepFailed
from msmpetsc.solve.energy_balance import NOTABLE_GAIN
from msmpetsc.solve.integrators.integrator import EnergyBudget
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.petsc.events import (
    CYCLE,
    FINE,
    GRIDS,
    HIERARCHY,
    LOCAL,
    REFERENCE,
    begun,
    seconds,
)
from msmpetsc.solve.presets import find_preset
from msmpetsc.solve.work import Work

REFERENCE_PRESET, REFERENCE_ERROR = "newton-multigrid", 1e-10
# prefix of the PETSc options of the reference solver
REFERENCE_PREFIX = "reference_"
EVENTS = {
    "factor": ["PCSetUp"],
    "local": [LOCAL.name],
    "ksp": ["KSPSolve"],
    "hierarchy": [GRIDS.name, HIERARCHY.name],
    "cycle": [CYCLE.name],
    "fine": [FINE.name],
}
# relative error of a step above which a warning is due [-]
FAR = 0.3


def true_errors(stepper: Stepper, problem: StepProblem, position: Positions) -> Floats:
    """Return the errors (2,) of a step's solution ``position`` (l, 3) [m] (collective).

    A reference solver solves the step to rounding; its time is not counted. The relative position
    error is |x - x*|_M / |y - x*|_M, the relative energy error (g(x) - g*) / (g(y) - g*). Both are
    NaN if the reference solve fails.
    """
    with begun(REFERENCE):
        reference = replace(
            stepper,
            preset=find_preset(REFERENCE_PRESET),
            error=REFERENCE_ERROR,
            max_iterations=None,
            prefix=REFERENCE_PREFIX,
        )
        try:
            reference.set_up()
            exact = reference.step(problem, position).position
            start, distance = (_distances(reference, x, exact) for x in (problem.y, position))
            errors: Floats = np.divide(distance, start, out=np.zeros(2), where=start > 0)
            errors[0] = reference.control.rounding.step_error(errors[0], start[0])
            return errors
        except StepFailed as failure:
            log.warning("the true error of a step is not known: its reference %s", failure)
            return np.full(2, np.nan)
        finally:
            reference.destroy()


def _distances(reference: Stepper, x: Positions, exact: Positions) -> Floats:
    """Return |x - x*|_M and g(x) - g* (collective)."""
    functional, vector = reference.functional, reference.functional.vectors.take()
    reference.unknowns.from_nodes(x - exact, vector)
    distance = functional.norm(vector)
    functional.vectors.give_back(vector)
    return np.array(
        [distance, functional.change(functional.at(x), functional.configuration(exact))[0]]
    )


def event_times() -> dict[str, float]:
    """Return the seconds that this rank has spent in each group of events.

    All runs of the process count; their reference solves do not.
    """
    return {name: sum(map(seconds, events)) for name, events in EVENTS.items()}


def times(comm: MPI.Comm, before: dict[str, float]) -> dict[str, float]:
    """Return the seconds in events since ``before``, the maximum over the ranks (collective).

    before : seconds of this rank, as ``event_times`` returned them
    """
    return {name: reduced(comm, now - before[name], MPI.MAX) for name, now in event_times().items()}


class Monitors:
    """Watch a run and warn once of each kind of trouble, alike on all ranks.

    work    : work of the steps since the last stored frame
    frames  : number of frames with inverted cells
    far     : number of frames with a step far from its solution
    gaining : number of steps with spurious energy
    """

    state: ClassVar[dict[str, Range]] = {
        **dict.fromkeys(("frames", "far", "gaining"), COUNT),
        "work": ANY,
    }

    def __init__(self, environment: Environment, time_step: float):
        self.environment, self.time_step, self.lattice = environment, time_step, environment.lattice
        self.comm = self.lattice.table.comm
        self.frames = self.far = self.gaining = 0
        self.work = Work()

    def _warn(self, index: int, time: float, text: str) -> None:
        log.warning("frame %d (t = %.6g s): %s", index, time, text)

    def inverted(self, index: int, time: float, q: Positions) -> int:
        """Return the number of inverted cells at q (l, 3) [m]; warn of the first (collective)."""
        count, worst = worst_inverted(self.comm, self.lattice, q)
        if count and not self.frames:
            remedy = "a smaller time.step or a smaller solver.error helps to keep them as they were"
            if self.lattice.solid is None:
                remedy = 'springs cannot turn them back, material.law = "neo-hookean" can'
            elif not index:
                remedy = "[start] puts them so, and a solid can turn them back"
            are = "s are" if count > 1 else " is"
            self._warn(index, time, f"{count} cell{are} inside out, the worst {worst}; {remedy}")
        self.frames += count > 0
        return count

    def error(self, index: int, time: float) -> None:
        """Warn if the estimated error of a frame's steps is above FAR."""
        error = self.work.step_error
        if not error <= FAR:
            if not self.far:
                off = "with no minimum near"
                if np.isfinite(error):
                    off = f"{error:.2g} off its solution, relative to what forces moved"
                remedies = (
                    "more solver.max_iterations, a solver.error in their place, or a smaller "
                    "time.step mend that"
                )
                self._warn(index, time, f"its step ended {off}; {remedies}")
            self.far += 1

    def overlaps(self, index: int, time: float, q: Positions) -> None:
        """Warn of nodes inside obstacles that begin to act in step ``index`` (collective).

        q : (l, 3) positions before the step [m]
        """
        for obstacle in self.environment.obstacles.all:
            if not obstacle.acts_at(time) or (index and obstacle.acts_at(time - self.time_step)):
                continue
            fixed = self.environment.anchors.fixed_at(time).all(axis=1)
            overlap = describe_overlap(self.comm, self.lattice, obstacle, q, fixed, time)
            if overlap:
                self._warn(
                    index,
                    time,
                    f'{overlap}; "exchange" leaves nodes inside, other responses push them out',
                )

    def gain(self, index: int, time: float, budget: EnergyBudget, remedy: str) -> None:
        """Warn if the spurious energy after a step is above NOTABLE_GAIN of all energy."""
        if not budget.share <= NOTABLE_GAIN:
            if not self.gaining:
                part = f"{budget.share * budget.put_in:.2g} J of {budget.put_in:.2g} J"
                share = f"{100 * budget.share:.2g}% of all energy"
                self._warn(index, time, f"{share}, {part}, came from nowhere; try {remedy}")
            self.gaining += 1

    def sum_up(self) -> None:
        """Log at the end of a run how often each kind of trouble occurred."""
        for count, trouble in (
            (self.frames, "cells were inside out"),
            (self.far, "steps ended far off their solution"),
            (self.gaining, "there was energy from nowhere"),
        ):
            if count:
                log.warning("%s in %d frames", trouble, count)
