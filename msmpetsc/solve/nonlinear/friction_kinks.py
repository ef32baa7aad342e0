"""Friction's kinks: which nodes' friction Newton's method takes by its secant, not by its true curvature.

Beyond a small slip the Hessian of friction has nothing along the slip. So Newton's full step takes a node that is about
to stick past the kink and round, the next one back, and the line search cuts each of them: of a lung that a plate
pressed, all of 79 nodes turned in most of 28 iterations. The parabola of the secant (contact.obstacles.friction)
never goes
too far, but comes in slowly where nodes slip on. So a step begins with secants; then only those nodes have them that
the last full step took over a kink.
"""

import numpy as np

from msmpetsc.contact.obstacles.penalty import Contact, Secants


class FrictionKinks:
    """The kinks of the step in progress.

    contact : of the step; None where there is none
    secants : of the next Hessian; None where there is no contact
    """

    def __init__(self) -> None:
        self.contact: Contact | None = None
        self.secants: Secants | None = None
        self.is_awaited = False

    def begin(self, contact: Contact | None) -> None:
        """Know nothing yet of a new step."""
        self.contact, self.is_awaited = contact, False
        self.secants = contact.all_secant() if contact else None

    def await_step(self) -> None:
        """A full step comes next: the Hessian was taken where it begins."""
        self.is_awaited = True

    def see(self, q: np.ndarray, base: np.ndarray) -> None:
        """Look at the full step from base to q (l, 3) [m], the first that is seen since it was awaited."""
        if self.is_awaited and self.contact:
            self.secants = self.contact.passes_kinks(q, base)
        self.is_awaited = False
