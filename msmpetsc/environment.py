"""Actions on a body from outside: forces, anchors, obstacles, and contact of the surface."""

from typing import Any

from mpi4py import MPI

from msmpetsc.backend.arrays import Indices, Positions
from msmpetsc.build import Model
from msmpetsc.constraints.acting import ActingForces, Anchors
from msmpetsc.constraints.loads import Anchor
from msmpetsc.contact.obstacles.moving_solid import Obstacle
from msmpetsc.contact.obstacles.node_obstacles import NodeObstacles
from msmpetsc.contact.obstacles.penalty import Contact
from msmpetsc.contact.surface.pairs import Contacts, NearPairs, Touch
from msmpetsc.contact.surface.term import SurfaceContact

GROWN = 4.0  # times more or less than the push that friction went by: then the step is solved again


class Environment:
    """Forces, anchors and obstacles of a model, and contact of its surface in a step.

    Positions are local, (l, 3) [m], ghosts included; ``time`` [s] is that of a step's end and
    ``time_step`` [s] its length; ``sides`` (o, l) are those of NodeObstacles.
    """

    def __init__(self, model: Model):
        self.lattice = model.lattice
        self.damping = model.damping  # of velocities, by the mass [1/s]
        self.retardation = model.retardation  # viscosity over stiffness [s]
        self.forces = ActingForces(model.lattice, model.loads, model.own_forces)
        self.anchors = Anchors(model.lattice, model.anchors)
        self.obstacles = NodeObstacles(model.lattice, model.penalties, model.exchanges)
        self.moving: list[Anchor | Obstacle] = [*model.anchors, *model.obstacles]
        self.self_contact = (
            NearPairs(self.lattice.table.comm, model.collision) if model.collision else None
        )
        self.contacts = (
            Contacts(self.self_contact, 0.0, 0.0) if self.self_contact else None
        )  # of the last step begun
        self.has_friction = self.obstacles.has_friction or bool(
            self.self_contact and self.self_contact.law.friction > 0
        )
        self._ended: tuple[Positions, Contact] | None = (
            None  # the last step, if it had contact, and what there was
        )
        self.touches = bool(model.penalties or self.self_contact)

    def events(self) -> list[float]:
        """Return the times [s] at which a load, an anchor or an obstacle begins, ends or turns."""
        turns = [time for moving in self.moving for time in moving.path.times.tolist()]
        return turns + [time for timed in (*self.forces.all, *self.moving) for time in timed.events]

    def is_same(self, begin: float, end: float) -> bool:
        """Return whether loads, anchors and obstacles are at one time [s] just as at another."""

        def at(time: float) -> list[Any]:
            loads: list[Any] = [load.state_at(time) for load in self.forces.all]
            return loads + [
                moving.acts_at(time) and tuple(moving.path.value_at(time)) for moving in self.moving
            ]

        return at(begin) == at(end)

    def contact(
        self,
        q: Positions,
        last: Positions | None,
        time: float,
        time_step: float,
        sides: Indices | None,
        end: Positions | None = None,
    ) -> Contact | None:
        """Return what presses in the step from q, with friction; None if nothing does (collective).

        last : (l, 3) [m] positions one step before q, of a step that looks back to them
        end  : (l, 3) [m] where an earlier solve of the step has ended: friction then goes by the push there
        """
        before, surface = self._before(q), None
        states = self.obstacles.during(q, last, end, (time, time_step), sides, before)
        if self.contacts and not self.contacts.apart:
            surface = SurfaceContact(
                self.contacts, q, time_step, last, end, before.surface if before else None
            )
        return Contact(states, self.lattice.owned, surface) if states or surface else None

    def begin_contacts(self, q: Positions, time: float, time_step: float) -> None:
        """Begin a step at q: the surface is asked about around its contacts alone, if these are few (collective)."""
        if self.self_contact:
            begin = max(time - time_step, 0.0)
            self.contacts = Contacts(self.self_contact, begin, time, self.contacts)
            self.contacts.narrow(q, begin)

    def _before(self, q: Positions) -> Contact | None:
        """Return the contact of the step that ended at q; None if the last one known did not."""
        if self._ended is None:
            return None
        ended, contact = self._ended
        return contact if self.lattice.table.comm.allreduce(q is ended, MPI.LAND) else None

    def end_step(self, x: Positions, contact: Contact | None) -> None:
        """A step has come to x (l, 3) [m]: friction of the next one goes on from there."""
        self._ended = (x, contact) if contact and self.has_friction else None

    def friction_lags(self, x: Positions, contact: Contact | None) -> bool:
        """Return whether friction of a step to x (l, 3) [m] went by a push far from the one there (collective)."""
        if not (contact and self.has_friction):
            return False
        by, at_end = self.lattice.table.comm.allreduce(contact.friction_limits(x))
        return bool(max(at_end, by) > GROWN * min(at_end, by))

    def forget(self) -> None:
        """Forget what earlier steps showed (collective)."""
        self._ended = None
        if self.self_contact:
            self.self_contact.forget()
            self.contacts = Contacts(self.self_contact, 0.0, 0.0)

    def touch(self, q: Positions, time: float) -> Touch:
        """Return what contacts the surface has with itself and obstacles at q and a time [s] (collective)."""
        return self.contacts.touch(q, time) if self.contacts else Touch()
