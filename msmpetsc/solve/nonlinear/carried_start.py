"""Start of a step with moving anchors or obstacles: a path to their places that crosses nothing.

The share s of the path of anchors and obstacles is a further unknown: s = 0 at the beginning of the
step, and s = 1 is the target. Newton's direction towards the minimum of g at s = 1 moves x and s,

    H(x, s) dx = -F(x, s) - (1 - s) dF/ds(x, s),      ds = 1 - s,

until two triangles would cross. So bodies give way to the obstacles that press them, as to the
moving boundaries of Li et al. (2020, Incremental Potential Contact). H is projected. No line search
evaluates g, since the path only has to reach s = 1.

A start without a linear solve is tried first: nodes move with the obstacles near them.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from petsc4py import PETSc

from msmpetsc.backend.arrays import Positions, Rows
from msmpetsc.comm import Stop
from msmpetsc.contact.surface.pairs import ContactSearch
from msmpetsc.errors import StepFailed, StepStopped
from msmpetsc.solve.nonlinear.functional import StepFunctional
from msmpetsc.solve.nonlinear.jacobian import Jacobian

# Greatest relative tolerance of a linear solve that moves anchors and obstacles [-];
# stiff contact dominates its right-hand side, so soft modes need more digits
MOVING_RTOL = 3e-5
# Greatest number of moves of anchors and obstacles in a step; pressing a body takes up
# to 46
MOST_MOVES = 100
# Number of corrections at fixed s before each move; a correction doubles a gap that the
# last move has closed
CORRECTIONS = 2


class CarriedStart:
    """Finder of starts that carry bodies along with anchors and obstacles.

    All methods are collective.

    ksp : solver of systems with the Jacobian
    """

    def __init__(self, functional: StepFunctional, jacobian: Jacobian, ksp: PETSc.KSP):
        self.functional, self.jacobian, self.ksp = functional, jacobian, ksp
        # Tolerances of the options; Newton's method changes the tolerances of ``ksp``
        self.rtol, _, _, self.most_its = ksp.getTolerances()

    def find(self, guess: Positions, drift: Callable[[Rows], Rows | float]) -> Positions:
        """Return the guess (l, 3) [m], or a start that the surface reaches without a crossing.

        drift : returns the mean displacement of a free body from displacements (l, 3) [m]

        Raises StepFailed if anchors and obstacles cannot reach their places, and StepStopped after
        a signal.
        """
        functional, problem = self.functional, self.functional.problem
        contacts = functional.surface.contacts if functional.surface else None
        if contacts is None:
            return guess
        share = functional.collision_free_step(problem.q, guess, contacts.begin)
        if share == 1.0:
            return guess
        end, obstacles, moved = contacts.time, contacts.obstacles, guess - problem.q
        if problem.prescribed is None and not obstacles.moves(contacts.begin, end):
            still = 0.0 if obstacles.total else drift(moved)
            return problem.q + share * moved + (1 - share) * still
        for displacement in (moved, 0 * moved):
            if obstacles.total:
                displacement = self._moved_with_obstacles(contacts, displacement)
            carried = np.where(
                functional.lattice.fixed, problem.fixed_positions, problem.q + displacement
            )
            if functional.collision_free_step(problem.q, carried, contacts.begin) == 1.0:
                return carried
        obstacles.straight = contacts.begin, end
        contacts.widen()
        try:
            return self._carry(contacts, end)
        finally:
            contacts.time, functional.problem, obstacles.straight = end, problem, None

    def _moved_with_obstacles(self, contacts: ContactSearch, moved: Rows) -> Rows:
        """Return displacements (l, 3) [m] with which nodes follow the obstacles that they touch.

        Nodes far from obstacles have the displacements ``moved``.
        """
        functional, q = self.functional, self.functional.problem.q
        owned = contacts.points.distances(q, contacts.begin) - contacts.law.distance
        distances = functional.lattice.table.with_ghosts(functional.lattice.ghosts, owned)
        times = contacts.begin, contacts.time
        return contacts.obstacles.carried(q, moved, times, distances, functional.lattice.cell_size)

    def _carry(self, contacts: ContactSearch, end: float) -> Positions:
        """Return the start at s = 1 by Newton's directions. Raises StepFailed and StepStopped."""
        functional, problem, begin = self.functional, self.functional.problem, contacts.begin
        is_fixed, still = functional.lattice.fixed, np.zeros((1, 3))
        q, s = problem.q, 0.0
        for _ in range(MOST_MOVES):
            now = begin + s * (end - begin)
            left = np.where(is_fixed, (1 - s) * (problem.fixed_positions - problem.q), 0.0)
            contacts.time, functional.problem = (
                now,
                replace(problem, prescribed=problem.fixed_positions - left),
            )
            for _ in range(CORRECTIONS):
                direction = self._direction(q, np.zeros_like(left), still, self.rtol)
                q = q + functional.collision_free_step(q, q + direction) * direction
            onward = contacts.obstacles.displacements(now, end)
            direction = self._direction(q, left, onward, min(self.rtol, MOVING_RTOL))
            contacts.time = end
            share = functional.collision_free_step(q, q + direction, now)
            if share == 1.0:
                return q + direction
            q, s = q + share * direction, s + share * (1 - s)
        contacts.time = begin + s * (end - begin)
        raise StepFailed(
            f"cannot lead anchors and obstacles on: "
            f"after {s:.0%} of their way {contacts.nearest(q)}; "
            'try other paths, or safety.on_failure = "substep"',
            "contact",
        )

    def _direction(self, q: Positions, fixed: Rows, obstacles: Rows, rtol: float) -> Rows:
        """Return Newton's direction (l, 3) [m] at q (l, 3) [m], fixed nodes included.

        fixed     : (l, 3) displacements of fixed nodes [m]
        obstacles : (o, 3) displacements of obstacles' points [m]
        rtol      : relative tolerance of the linear solve

        Raises StepStopped after a signal.
        """
        functional, unknowns = self.functional, self.functional.unknowns
        x, change, f = (functional.vectors.take() for _ in range(3))
        contact = functional.problem.contact
        assert contact is not None
        if Stop.agreed(functional.comm):
            raise StepStopped("stopped by a signal")
        unknowns.from_nodes(q, x)
        now = functional.evaluate(x, f, functional.configuration(q))
        assert now.contact is not None and now.contact.surface is not None
        self.jacobian.linearise(now, True, contact.no_duals())
        forces = self.jacobian.hessian.forces(fixed)
        now.contact.surface.add_change_of_gradient(obstacles, forces)
        unknowns.scaled_sum(np.zeros_like(q), functional.t2, forces, change)
        f.axpy(1.0, change)
        tolerances = self.ksp.getTolerances()
        self.ksp.setInitialGuessNonzero(False)
        self.ksp.setTolerances(rtol=rtol, max_it=self.most_its)
        self.ksp.solve(f, x)
        self.ksp.setTolerances(*tolerances)
        x.scale(-1.0)
        direction = fixed.copy()
        unknowns.to_nodes(x, direction)
        for vector in (x, change, f):
            functional.vectors.give_back(vector)
        return direction
