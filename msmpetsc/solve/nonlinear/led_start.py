"""Start of a step whose anchors or obstacles move: a way to their places on which the surface crosses nothing.

The share s of their way, 0 where the step begins and 1 where it ends, is an unknown beside x with the target 1.
Newton's direction towards the minimum of g at s = 1 carries both,

    H(x, s) dx = -F(x, s) - (1 - s) dF/ds(x, s),      ds = 1 - s,

and both follow it until two triangles would meet. So bodies give way to the obstacles that press them, as to the
moving boundaries of Li et al. (2020, Incremental Potential Contact). Obstacles push from farther off meanwhile
(Barrier.cushioned): gaps are wide enough for a way, and contact is soft. The minimisation begins at s = 1, with the
usual barrier. H has no negative parts, and no line search asks for g: the way only has to lead to the end.

Nodes that go with the obstacles near them need no such solve, and are tried first.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Positions, Rows, greatest
from msmpetsc.comm import Stop
from msmpetsc.contact.surface.pairs import Contacts
from msmpetsc.errors import StepFailed, StepStopped
from msmpetsc.solve.linear.unknowns import with_ghosts
from msmpetsc.solve.nonlinear.functional import StepFunctional
from msmpetsc.solve.nonlinear.jacobian import Jacobian

Vectors: TypeAlias = tuple[PETSc.Vec, PETSc.Vec, PETSc.Vec]

# Directions between looks at the progress: a press takes 5 to 30
PATIENCE = 20
# Progress in s between looks: with less, the step is refused
PROGRESS = 0.1
# Directions at fixed s after each share: a direction doubles a gap that the share has closed
CORRECTIONS = 2
# ksp_rtol of a direction: the way only has to lead to the end
RTOL = 1e-2


class LedStart:
    """Way from where a step begins to a start at its end. All methods are collective.

    ksp     : solves with the Jacobian
    vectors : three of unknowns, that are written to
    """

    def __init__(
        self, functional: StepFunctional, jacobian: Jacobian, ksp: PETSc.KSP, vectors: Vectors
    ):
        self.functional, self.jacobian, self.ksp, self.vectors = functional, jacobian, ksp, vectors
        self.most_its = ksp.getTolerances()[3]

    def reach(self, guess: Positions, drift: Callable[[Rows], Rows | float]) -> Positions:
        """Return the guess (l, 3) [m], or a start that the surface reaches without crossing anything.

        drift : mean displacement of a free body that moves so (l, 3) [m]
        Raises StepFailed where anchors and obstacles cannot reach the end of the step.
        """
        functional, problem = self.functional, self.functional.problem
        contacts = functional.surface.contacts if functional.surface else None
        if contacts is None:
            return guess
        share = functional.free_share(problem.q, guess, contacts.begin)
        if share == 1.0:
            return guess
        end, obstacles, moved = contacts.time, contacts.obstacles, guess - problem.q
        if problem.prescribed is None and contacts.same(contacts.begin, end):
            still = 0.0 if obstacles.total else drift(moved)
            return problem.q + share * moved + (1 - share) * still
        for way in (moved, 0 * moved):
            if obstacles.total:
                way = self._carried(contacts, way)
            carried = np.where(functional.lattice.pinned[:, None], problem.fixed, problem.q + way)
            if functional.free_share(problem.q, carried, contacts.begin) == 1.0:
                return carried
        obstacles.straight = contacts.begin, end
        try:
            with contacts.cushioned(self._cushion(contacts)):
                return self._lead(contacts, end)
        finally:
            contacts.time, functional.problem, obstacles.straight = end, problem, None

    def _carried(self, contacts: Contacts, moved: Rows) -> Rows:
        """Return how far nodes go in the step, (l, 3) [m]: with obstacles that they touch, or by ``moved``."""
        functional, q = self.functional, self.functional.problem.q
        owned = contacts.points.distances(q, contacts.begin) - contacts.law.distance
        distances, times = (
            with_ghosts(functional.comm, functional.lattice, owned),
            (contacts.begin, contacts.time),
        )
        return contacts.obstacles.carried(q, moved, times, distances, functional.lattice.cell_size)

    def _cushion(self, contacts: Contacts) -> float:
        """Return the distance [m] from which obstacles push bodies that are led: the farthest way of a held part."""
        problem, obstacles = (
            self.functional.problem,
            contacts.obstacles.way(contacts.begin, contacts.time),
        )
        held = self.functional.comm.allreduce(greatest(np.abs(problem.fixed - problem.q)), MPI.MAX)
        return float(max(held, greatest(np.abs(obstacles)), contacts.law.distance))

    def _lead(self, contacts: Contacts, end: float) -> Positions:
        """Return the start at s = 1. Raises StepFailed."""
        functional, problem, begin = self.functional, self.functional.problem, contacts.begin
        is_held, still = functional.lattice.pinned[:, None], np.zeros((1, 3))
        q, s, gained = problem.q, 0.0, 1.0
        while gained > PROGRESS:
            begun = s
            for _ in range(PATIENCE):
                now = begin + s * (end - begin)
                left = np.where(is_held, (1 - s) * (problem.fixed - problem.q), 0.0)
                contacts.time, functional.problem = (
                    now,
                    replace(problem, prescribed=problem.fixed - left),
                )
                for _ in range(CORRECTIONS):
                    way = self._direction(q, np.zeros_like(left), still)
                    q = q + functional.free_share(q, q + way) * way
                way = self._direction(q, left, contacts.obstacles.way(now, end))
                contacts.time = end
                share = functional.free_share(q, q + way, now)
                if share == 1.0:
                    return q + way
                q, s = q + share * way, s + share * (1 - s)
            gained = s - begun
        contacts.time = begin + s * (end - begin)
        raise StepFailed(
            f"cannot lead anchors and obstacles on: after {s:.0%} of their way {contacts.nearest(q)}; "
            'try other paths, or safety.on_failure = "substep"',
            "contact",
        )

    def _direction(self, q: Positions, held: Rows, obstacles: Rows) -> Rows:
        """Return Newton's direction (l, 3) [m] at q (l, 3) [m], held nodes included.

        held, obstacles : how far held nodes (l, 3) and obstacles' points (o, 3) go along it [m]
        """
        functional, unknowns, (x, change, f) = (
            self.functional,
            self.functional.unknowns,
            self.vectors,
        )
        contact = functional.problem.contact
        assert contact is not None and contact.surface is not None
        if Stop.agreed(functional.comm):
            raise StepStopped("stopped by a signal")
        unknowns.from_nodes(q, x)
        functional.evaluate(x, f)
        self.jacobian.linearise(q, contact, True, contact.no_duals())
        forces = self.jacobian.hessian.forces(held)
        contact.surface.add_change_of_gradient(q, obstacles, forces)
        unknowns.scaled_sum(np.zeros_like(q), functional.t2, forces, change)
        f.axpy(1.0, change)
        tolerances = self.ksp.getTolerances()
        self.ksp.setInitialGuessNonzero(False)
        self.ksp.setTolerances(rtol=RTOL, max_it=self.most_its)
        self.ksp.solve(f, x)
        self.ksp.setTolerances(*tolerances)
        x.scale(-1.0)
        way = held.copy()
        unknowns.to_nodes(x, way)
        return way
