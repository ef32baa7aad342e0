"""Steps that fail as if they did not converge."""

import pytest

from msmpetsc.errors import StepFailed
from msmpetsc.solve.nonlinear.step import Stepper


class Failing:
    """Patch of the stepper: it fails at the given calls, as a step that does not converge."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, calls: set[int]):
        self.calls, self.count, self.prefixes, step = calls, 0, [], Stepper.step

        def failing(stepper: Stepper, *given, **named):
            self.count += 1
            self.prefixes.append(stepper.options.prefix)
            if self.count in self.calls:
                raise StepFailed("did not converge: as the test has it; try nothing", "line search")
            return step(stepper, *given, **named)

        monkeypatch.setattr(Stepper, "step", failing)
