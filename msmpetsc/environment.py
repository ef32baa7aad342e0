"""The actions on a body at a given time: forces, anchors, obstacles and surface contact."""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

from mpi4py import MPI

from msmpetsc.backend.arrays import Indices, Positions
from msmpetsc.build import Model
from msmpetsc.comm import reduced
from msmpetsc.constraints.anchors import Anchor, Anchors
from msmpetsc.constraints.forces import ActingForces
from msmpetsc.contact.obstacles.moving_solid import Obstacle
from msmpetsc.contact.obstacles.node_obstacles import NodeObstacles
from msmpetsc.contact.step_contact import StepContact, StepContactAt
from msmpetsc.contact.surface.pairs import ContactSearch, ContactSummary
from msmpetsc.contact.surface.surface_contact import SurfaceContact, SurfaceContactAt
from msmpetsc.elasticity.energy import Elasticity

# largest factor between the friction limit used in a step and mu N at its end [-];
# beyond it the step is solved again with the new limit
LAG_LIMIT = 4.0


class Environment:
    """Forces, anchors, obstacles and surface contact of a model during a step.

    Positions (l, 3) [m] are local and include ghosts. ``time`` [s] is the end of a step and
    ``time_step`` [s] its length. ``sides`` (o, l) tells on which side of each thin obstacle a node
    is (NodeObstacles).

    damping     : mass-proportional damping rate [1/s]
    retardation : viscosity over stiffness [s]
    contacts    : surface contacts; None without surface contact
    touches     : whether the model has penalty obstacles or surface contact
    system_monitor : function called with the first iterate of each solve and its Jacobian, or None
    """

    def __init__(self, model: Model):
        self.lattice = model.lattice
        self.damping = model.damping
        self.retardation = model.retardation
        self.forces = ActingForces(model.lattice, model.loads, model.own_forces, model.pressures)
        self.anchors = Anchors(model.lattice, model.anchors)
        self.obstacles = NodeObstacles(model.lattice, model.penalties, model.exchanges)
        self.moving: list[Anchor | Obstacle] = [*model.anchors, *model.obstacles]
        self.contacts = ContactSearch(model.collision) if model.collision else None
        # Contact at the end of the last step; None without contact
        self._ended: StepContactAt | None = None
        self.touches = bool(model.penalties or self.contacts)
        self.system_monitor: Callable[[Any, Any], None] | None = None

    @cached_property
    def elasticity(self) -> Elasticity:
        """Elastic energy of the model's lattice."""
        return Elasticity(self.lattice)

    def events(self) -> list[float]:
        """Return the times [s] at which a load or a motion starts, stops or changes its slope."""
        kinks = [time for moving in self.moving for time in moving.path.times.tolist()]
        return kinks + [time for timed in (*self.forces.all, *self.moving) for time in timed.events]

    def is_same(self, begin: float, end: float) -> bool:
        """Return whether loads, anchors and obstacles are the same at two times [s]."""

        def at(time: float) -> list[Any]:
            loads: list[Any] = [tuple(load.state_at(time)) for load in self.forces.all]
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
        end: StepContactAt | None = None,
    ) -> StepContact | None:
        """Return the contact of a step from q, with friction; None without contact (collective).

        ``begin_contacts`` has begun the step.

        last : positions (l, 3) [m] one step before q, for a two-step method
        end  : contact at the end of an earlier solve of this step, whose normal forces then limit
            friction
        """
        previous = self._previous_contact(q)
        surface = None
        ended = end.q if end else None
        states = self.obstacles.during(q, last, ended, (time, time_step), sides, previous)
        if self.contacts and not self.contacts.is_left_out:
            start = self.contacts.start
            assert start is not None
            pairs = end.surface.pairs if end and end.surface else None
            before = previous.surface if previous else None
            surface = SurfaceContact(self.contacts, start, time_step, last, pairs, before)
        return StepContact(states, self.lattice.owned, surface) if states or surface else None

    def push(self, q: Positions, time: float, sides: Indices | None) -> StepContactAt | None:
        """Return the contact at q and a time [s] without friction, or None (collective)."""
        of_nodes = self.obstacles.push(time, sides)
        if not self.contacts:
            return of_nodes.at(q) if of_nodes else None
        pairs = self.contacts.pairs_at(q, time)
        # Points that have not slipped have no friction
        surface = SurfaceContactAt(SurfaceContact(self.contacts, pairs, 1.0), pairs)
        return replace((of_nodes or StepContact([], self.lattice.owned)).at(q), surface=surface)

    def begin_contacts(self, q: Positions, time: float, time_step: float) -> None:
        """Search the candidate pairs of the surface for a step from q that ends at ``time``.

        If contacts are few, only pairs near them are candidates (collective).
        """
        if self.contacts:
            self.contacts.narrow(self.contacts.begin_step(q, max(time - time_step, 0.0), time))

    def _previous_contact(self, q: Positions) -> StepContact | None:
        """Return the contact of the last step if it ended at q, otherwise None (collective)."""
        ended = self._ended
        if ended is None or not reduced(self.lattice.table.comm, q is ended.q, MPI.LAND):
            return None
        return ended.step

    def settle_contacts(
        self, contact: StepContactAt | None, x: Positions, tolerance: float
    ) -> tuple[StepContactAt | None, bool, bool]:
        """Return the contact at a solution with all pairs, and whether the solution is right.

        Also return whether the surface crosses nothing on the path to the solution (collective). If
        the step left the surface out, the contact has no surface.

        contact   : contact at the solution x (l, 3) [m], with the pairs used
        tolerance : as in ContactSearch.settle [J]
        """
        if not self.contacts:
            return contact, True, True
        surface = contact.surface if contact else None
        used = surface.pairs if surface else None
        is_right, is_free = self.contacts.settle(used, x, tolerance)
        if contact and surface and self.contacts.end:
            contact = replace(contact, surface=replace(surface, pairs=self.contacts.end))
        return contact, is_right, is_free

    def narrow_contacts(self) -> None:
        """Use only candidate pairs around the contacts at the last solution if these are few."""
        if self.contacts and self.contacts.end:
            self.contacts.narrow(self.contacts.end)

    def end_step(self, contact: StepContactAt | None) -> None:
        """Record the contact at the end of a step, from which friction continues."""
        self._ended = contact

    def friction_lags(self, contact: StepContactAt | None) -> bool:
        """Return whether friction in a step used an outdated limit (collective).

        The limit is outdated if it differs from mu N at the step's end by more than a factor of
        LAG_LIMIT.

        contact : contact at the end of the step
        """
        if not contact:
            return False
        used, at_end = reduced(self.lattice.table.comm, contact.friction_limits())
        return bool(max(at_end, used) > LAG_LIMIT * min(at_end, used))

    def forget(self) -> None:
        """Clear the contact history, so that the next step depends on q alone (collective)."""
        self._ended = None
        if self.contacts:
            self.contacts.forget()

    def touch(self, q: Positions, time: float) -> ContactSummary:
        """Return number, least distance and energy of surface contacts at q (collective).

        time : [s]
        """
        if not self.contacts:
            return ContactSummary()
        return self.contacts.summary(self.contacts.pairs_at(q, time))
