"""The two kinds of self-contact: a barrier that nothing crosses, and a penalty for surfaces that cross at rest."""

from typing import TypeAlias

import numpy as np
from mpi4py import MPI

from msmpetsc.model.self_contact.cell_contacts import CellContact, CellContacts, CellHessian, OverlappingSurface
from msmpetsc.model.self_contact.contacts import CollisionSurface, Contacts
from msmpetsc.model.self_contact.term import SurfaceContact, SurfaceHessian

RunContacts: TypeAlias = Contacts | CellContacts
StepContact: TypeAlias = SurfaceContact | CellContact
ContactHessian: TypeAlias = SurfaceHessian | CellHessian


def contacts_of(comm: MPI.Comm, collision: CollisionSurface | OverlappingSurface) -> RunContacts:
    """Return the contacts of a run (collective)."""
    if isinstance(collision, OverlappingSurface):
        return CellContacts(comm, collision)
    return Contacts(comm, collision)


def term_of(contacts: RunContacts, start: np.ndarray, time_step: float) -> StepContact:
    """Return what they add to the energy in a step that begins at ``start`` (l, 3) [m] (collective)."""
    if isinstance(contacts, CellContacts):
        return contacts.during(start)
    return SurfaceContact(contacts, start, time_step)
