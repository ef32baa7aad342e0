"""Mass-proportional damping, the forces -alpha M v, in implicit steps and in Verlet's substeps.

An implicit step has v = (x - c) / tau and y = c + tau w (solve.integrators.implicit). Damping gives

    M (x - c - tau w) + tau alpha M (x - c) + tau^2 (grad E(x) - f_ext) = 0.

Division by 1 + alpha tau gives an undamped problem with

    y = c + tau w / (1 + alpha tau)    and    tau^2 / (1 + alpha tau) for tau^2.

Damping therefore costs nothing. Without forces, a step divides the velocity by 1 + alpha tau. In
Verlet's substeps the velocity decays by exp(-alpha dt).
"""

import numpy as np


def equivalent_tau(tau: float, alpha: float) -> float:
    """Return tau [s] of the undamped problem that equals a problem with damping alpha [1/s]."""
    return tau / float(np.sqrt(1 + alpha * tau))


def carried_time(duration: float, alpha: float) -> float:
    """Return the time [s] for which a velocity acts in an implicit step of a duration [s]."""
    return duration / (1 + alpha * duration)


def decay(duration: float, alpha: float) -> float:
    """Return the factor of a velocity [-] after a duration [s] without other forces."""
    return float(np.exp(-alpha * duration))
