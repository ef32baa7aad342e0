"""Contact faces of an implicit step: by which face each node is pushed out of an obstacle."""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Indices, Mask, Positions
from msmpetsc.environment import Environment
from msmpetsc.errors import StepFailed
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.petsc.events import CONTACT

MOST_SOLVES = 10  # of a step, for nodes that pass through a box


@dataclass
class ContactFaces:
    """Search for the faces of one step, from q to its end. All methods are collective.

    They are settled before the step is solved, by the way to y. Where the way to x shows others,
    the step is solved again; from then on a node that has a face keeps it, so that this ends.

    q, y       : (l, 3) [m], as a StepProblem has them
    q_before   : (l, 3) [m] one step before q, of a step that looks so far back
    sides      : (o, l) faces of the problem to solve; once settled, those of the step
    is_settled : the problem solved last was the right one
    """

    comm: MPI.Comm
    environment: Environment
    q: Positions
    y: Positions
    time: float  # of the step's end [s]
    time_step: float
    before: Indices | None  # (o, l) faces when it began (environment); None: the nearest
    fixed: Mask  # (l,) bool, nodes that are no unknowns
    q_before: Positions | None = None

    def __post_init__(self) -> None:
        self.solves = 0
        self.is_settled = False
        self.sides = self._crossed(self.y)

    def _crossed(self, end: Positions) -> Indices:
        """Sides (o, l) of nodes that go straight from q to ``end`` (l, 3) [m]."""
        with CONTACT:
            return self.environment.contact_faces(self.q, end, self.time, self.time_step, self.before, self.fixed)

    def problem(self) -> StepProblem:
        """The step with the faces as they are known now."""
        environment, time = self.environment, self.time
        contact = environment.contact(self.q, self.y, time, self.time_step, self.sides, self.q_before)
        return StepProblem(self.q, self.y, environment.load(time), contact, environment.prescribed(self.q, time))

    def compare(self, x: Positions) -> None:
        """Update the faces from the solution x (l, 3) [m]. Raises StepFailed where none settle."""
        crossed, pressing = self._crossed(x), self.environment.pressing
        sides = np.where(self.sides > 0, self.sides, crossed) if self.solves else crossed
        self.solves += 1
        environment, differs = self.environment, False
        if environment.has_sides and environment.penalties:  # which may press otherwise
            alike = environment.same_push(x, self.time, self.sides, sides)
            differs = self.comm.allreduce(not alike, MPI.LOR)
        self.is_settled = not differs
        if differs:
            self.sides = sides
            if self.solves == MOST_SOLVES:
                raise StepFailed(
                    f"has nodes that pass through an obstacle, solved {MOST_SOLVES} times with the face that each came "
                    'in by; try a smaller time.step, or safety.on_failure = "substep"',
                    "contact",
                )
            return
        if self.environment.penalties:  # what reflects goes by the way to x alone
            crossed[pressing] = np.where(sides > 0, sides, self.sides)[pressing]
        self.sides = crossed
