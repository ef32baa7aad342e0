"""First guess of a step: the best of several cheap guesses."""

import numpy as np

from msmpetsc.backend.arrays import Floats, Positions, Rows, like, to_host
from msmpetsc.comm import reduced
from msmpetsc.solve.nonlinear.functional import StepFunctional


class FirstGuess:
    """Guesses for the steps of one lattice.

    extrapolate : whether to take the guess of least g; if not, y as published
    """

    def __init__(self, functional: StepFunctional, extrapolate: bool):
        self.functional, self.extrapolate = functional, extrapolate
        # Whether some components are fixed and thus no unknowns
        self.has_fixed = functional.unknowns.has_fixed
        # c = x - y of the last steps (l, 3) [m], at most two, the newest first
        self.corrections: list[Positions] = []

    def best(self) -> Positions:
        """Return the best guess (l, 3) [m] for the step that the functional has begun (collective).

        The guesses are y; y plus the extrapolated elastic corrections of the last steps; the free
        flight y + t^2 M^(-1) f_ext; and q_n moved by the mean displacement of the free flight. The
        mean displacement keeps the momentum of a free body even if the step stops early.
        """
        problem, lattice = self.functional.problem, self.functional.lattice
        q, y = problem.q, problem.y
        if not self.extrapolate:
            return y
        flight = y.copy()
        flight[: lattice.owned] += self.functional.t2 * problem.load / lattice.mass[:, None]
        surface = self.functional.surface
        pressing = surface.contacts if surface and surface.start.count else None
        guesses = [y]
        # The flight's mean would lead through obstacles that press, and g is not
        # meaningful beyond them.
        if pressing is None or not pressing.obstacles.total:
            guesses.append(q + self.drift(flight - q))
        if self.corrections:
            guesses.append(y + 2 * self.corrections[0] - self.corrections[-1])
        # A free flight would lead into parts that press on each other
        if pressing is None:
            guesses.append(flight)
        values = [self.functional.value(self.with_fixed(guess)) for guess in guesses]
        return guesses[int(np.argmin(values))]

    def learn(self, x: Positions) -> None:
        """Store the correction of a step that ended at x (l, 3) [m]."""
        self.corrections = [x - self.functional.problem.y, *self.corrections[:1]]

    def forget(self) -> None:
        """Forget the corrections of earlier steps."""
        self.corrections = []

    def with_fixed(self, guess: Positions) -> Positions:
        """Return the guess (l, 3) [m] with fixed nodes at their places after the step."""
        if not self.has_fixed:
            return guess
        fixed = self.functional.lattice.fixed
        return np.where(fixed, self.functional.problem.fixed_positions, guess)

    def drift(self, moved: Rows) -> Floats | float:
        """Return the mean (3,) by mass of displacements (l, 3) [m]; 0 if some nodes are fixed."""
        if self.has_fixed:
            return 0.0
        mass = self.functional.lattice.mass
        sums = np.append(to_host(mass @ moved[: len(mass)]), float(mass.sum()))
        sums = reduced(self.functional.comm, sums)
        return like(moved, sums[:3] / sums[3])
