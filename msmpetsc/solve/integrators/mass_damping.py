"""Mass-proportional damping, with forces -alpha M v, in implicit steps and in Verlet's substeps.

An implicit step has v = (x - c) / tau and y = c + tau w (solve.integrators.implicit). With damping,
the step solves

    M (x - c - tau w) + tau alpha M (x - c) + tau^2 (grad E(x) - f_ext) = 0.

Division by 1 + alpha tau gives an undamped problem with

    y = c + tau w / (1 + alpha tau)    and    tau^2 / (1 + alpha tau) for tau^2.

Damping therefore costs nothing. Without other forces, a step divides the velocity by
1 + alpha tau. In Verlet's substeps the velocity decays by exp(-alpha dt).
"""

import numpy as np


def equivalent_tau(tau: float, alpha: float) -> float:
    """Return tau [s] of the undamped problem equal to a problem with damping alpha [1/s]."""
    return tau / float(np.sqrt(1 + alpha * tau))


def carried_time(duration: float, alpha: float) -> float:
    """Return d / (1 + alpha d) [s], the time in which a velocity acts in a step of length d [s]."""
    return duration / (1 + alpha * duration)


def decay(duration: float, alpha: float) -> float:
    """Return the factor [-] by which a velocity decays in a ``duration`` [s], without forces."""
    return float(np.exp(-alpha * duration))
