"""First guess of a step: the best of a few guesses that cost next to nothing."""

import numpy as np

from msmpetsc.backend.arrays import Floats, Positions, Rows, like, to_host
from msmpetsc.solve.nonlinear.functional import StepFunctional


class FirstGuess:
    """Guesses for the steps of one lattice.

    extrapolate : the guess of least g, not y as published
    """

    def __init__(self, functional: StepFunctional, extrapolate: bool):
        self.functional, self.extrapolate = functional, extrapolate
        self.holds = (
            functional.unknowns.total < functional.lattice.table.total
        )  # some nodes are no unknowns
        self.corrections: list[
            Positions
        ] = []  # c = x - y of the last steps (l, 3) [m], at most two, the newest first

    def best(self) -> Positions:
        """The start (l, 3) [m] of the step that the functional has begun (collective).

        Besides y, as published: y and the elastic corrections of the last steps, extrapolated; q_n, moved by
        what the free flight moves on average where nothing is held, so that a step that stops early keeps the momentum;
        and the free flight y + t^2 M^(-1) f_ext itself.
        """
        problem, lattice = self.functional.problem, self.functional.lattice
        q, y = problem.q, problem.y
        if not self.extrapolate:
            return y
        flight = y.copy()
        flight[: lattice.owned] += self.functional.t2 * problem.load / lattice.mass[:, None]
        guesses = [y, q + self.drift(flight - q)]
        if self.corrections:
            guesses.append(y + 2 * self.corrections[0] - self.corrections[-1])
        surface = self.functional.surface
        met = surface is not None and surface.presses(q)  # parts of it push each other
        if not met:  # else a free flight leads into what presses
            guesses.append(flight)
        values = [self.functional.value(self.held(guess)) for guess in guesses]
        best = self._least(guesses, values) if surface and met else int(np.argmin(values))
        return guesses[best]

    def _least(self, guesses: list[Positions], without: list[float]) -> int:
        """The guess (a number) of least g, of which ``without`` is that without self-contact.

        Self-contact costs most to ask for, and takes no more away than it, or an elastic slip, stores at the start.
        """
        functional = self.functional
        problem, best, least = functional.problem, 0, np.inf
        assert functional.surface is not None
        contacts = functional.surface.contacts
        stored = functional.t2 * contacts.touch(problem.q, contacts.begin).energy
        for number in np.argsort(without):
            if without[number] - stored >= least:
                break
            value = functional.value(self.held(guesses[number]), True)
            if value < least:
                best, least = int(number), value
        return best

    def learn(self, x: Positions) -> None:
        """The step has come to x (l, 3) [m]."""
        self.corrections = [x - self.functional.problem.y, *self.corrections[:1]]

    def forget(self) -> None:
        """Forget what earlier steps showed."""
        self.corrections = []

    def held(self, guess: Positions) -> Positions:
        """The guess, but with the held nodes where they will be."""
        lattice = self.functional.lattice
        return (
            np.where(lattice.pinned[:, None], self.functional.problem.fixed, guess)
            if self.holds
            else guess
        )

    def drift(self, moved: Rows) -> Floats | float:
        """Mean by mass (3,) of a free body's displacements (l, 3) [m]; 0 if some nodes are held."""
        if self.holds:
            return 0.0
        mass = self.functional.lattice.mass
        sums = np.append(to_host(mass @ moved[: len(mass)]), float(mass.sum()))
        sums = self.functional.comm.allreduce(sums)
        return like(moved, sums[:3] / sums[3])
