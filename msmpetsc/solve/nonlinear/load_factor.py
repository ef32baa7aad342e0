"""Load factor of a body, by linear buckling analysis.

The load factor nu is the greatest number with H v = (1 - nu) H+ v. H+ is the projected Hessian,
which has all of M and nothing negative, so no eigenvalue of M^(-1) H is below 1 - nu. A body
buckles at nu = 1. The load factor grows as the load does, so a load factor serves many steps.
"""

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Positions, greatest, like
from msmpetsc.checkpoint import Checkpoint
from msmpetsc.solve.linear.operators import TrueHessian
from msmpetsc.solve.nonlinear.lobpcg import DEPENDENT, LONGEST_SEARCH, UNIFORM_EFFORT, Lobpcg

# Growth of the compression, or of the mode's curvature, beyond which another mode may
# be the lowest
MORE = 1.25
# Load factor up to which no mode need be known
LIGHT = 0.5
# Safety factor on a load factor of few iterations, which is a lower bound
UNSEEN = 1.2
# Growth of the compression up to which a body counts as loaded alike
GROWN = 4.0
# Share of the greatest compression below which a node does not tell how the load has
# grown
UNLOADED = 0.3
# Name of the load factor in a checkpoint, which older versions read
STORED = "LowestCurvature.load"


class LoadFactor:
    """Load factor of a step's Hessian, carried from step to step. All methods are collective.

    value : last load factor, infinite if there is none
    loads : compression (m,) of this rank's free nodes at the last load factor
    """

    def __init__(self, search: Lobpcg):
        self.search, self.functional, self.value = search, search.functional, np.inf
        self.free = self.functional.unknowns.free
        self.loads = np.zeros_like(self.functional.lattice.mass[self.free])
        self._mode: Floats | None = None

    def bound(self, q: Positions, ratios: Floats) -> float:
        """Return an upper bound of the load factor at positions q (l, 3) [m].

        While a body is loaded alike, its load factor grows as its compression does.

        ratios : compression (m,) of this rank's free nodes
        """
        comm, preconditioner = self.search.comm, self.search.preconditioner
        floor = UNLOADED * max(comm.allreduce(greatest(self.loads), MPI.MAX), DEPENDENT)
        growth = comm.allreduce(greatest(ratios / np.maximum(self.loads, floor)), MPI.MAX)
        bound: float = UNSEEN * self.value * growth
        # So near the limit that the next growth would need another search
        is_heavy = MORE * UNSEEN * self.value > LIGHT
        if not np.isfinite(bound) or (not is_heavy and (growth > GROWN or bound > LIGHT)):
            with preconditioner.searching(q, self.functional.contact_at(q)):
                self.value = self._computed(q) if preconditioner.is_uniform else np.inf
            self.loads, bound = ratios, UNSEEN * self.value
        return bound

    def _computed(self, q: Positions) -> float:
        """Return the greatest nu with H v = (1 - nu) H+ v, H+ the projected Hessian."""
        functional, hessian = self.functional, self.search.hessian
        projected = TrueHessian(
            functional.unknowns, functional.elasticity, functional.time_step, hessian.contact
        )
        projected.linearise(q, functional.contact_at(q), True)
        known = [] if self._mode is None else [self._mode[None]]
        start = np.concatenate([*known, self.search.random(2 - len(known))])
        values, modes = self.search.lowest(
            start, 2, LONGEST_SEARCH, UNIFORM_EFFORT.least - len(known), projected.mult
        )
        self._mode = modes[0].copy()
        hessian.products += projected.products
        return 1 - float(values[0])

    def save(self, checkpoint: Checkpoint) -> None:
        """Store the load factor and the compression that it belongs to."""
        loads = np.zeros_like(self.functional.lattice.mass)
        loads[self.free] = self.loads
        checkpoint.keep({"loads": loads}, {STORED: self.value})

    def restore(self, checkpoint: Checkpoint) -> None:
        """Restore the load factor and its compression."""
        self.value = checkpoint.number(STORED, self.value)
        self.loads = like(self.functional.mass, checkpoint.row("loads"))[self.free]

    def forget(self, all_of_it: bool) -> None:
        """Forget what a checkpoint does not hold; ``all_of_it``: the load factor, too."""
        self._mode = None
        if all_of_it:
            self.value = np.inf
