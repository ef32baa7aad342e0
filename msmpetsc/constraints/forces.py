"""External forces on nodes: gravity, forces and tractions over time, users' forces, pressures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows, like, to_host
from msmpetsc.constraints.time_functions import Lines, Timed
from msmpetsc.elasticity.pressure import Pressures
from msmpetsc.errors import InputError, printable
from msmpetsc.extensions import ForceFunction
from msmpetsc.lattice.lattice import Lattice

if TYPE_CHECKING:
    from mpi4py import MPI

    from msmpetsc.lattice.embedded_surface import SurfacePart

# the function 1
ALWAYS = Lines(np.zeros(1), np.ones((1, 1)))


@dataclass(frozen=True, kw_only=True)
class Varying(Timed):
    """A load whose total is a function of time."""

    total: Lines

    def state_at(self, time: float) -> Floats:
        """Return the total at a time [s]; zeros if the load does not act."""
        return self.acts_at(time) * self.total.value_at(time)

    def mean(self, begin: float, end: float) -> Floats:
        """Return the mean of the total from begin to end [s]."""
        return self.total.mean(begin, end, self.start, self.stop)

    @property
    def events(self) -> list[float]:
        """Return the times [s] at which the load begins, ends or changes its slope."""
        return [*super().events, *self.total.times.tolist()]


@dataclass(frozen=True)
class Load(Varying):
    """A force on nodes: each node's share times the total.

    share : (owned, 1) share of each node in the total [-]; for gravity its mass [kg], for a
            traction its area [m^2]
    total : total force [N]; for gravity the acceleration [m/s^2], for a traction [Pa]
    """

    share: Rows


@dataclass(frozen=True)
class PressureLoad(Varying):
    """A pressure [Pa] on a part of the surface, positive if it pushes into the body."""

    part: "SurfacePart"


@dataclass(frozen=True)
class OwnForce(Varying):
    """A force that a user's function defines (extensions.register_force).

    key      : key of its table in the scene, for messages
    function : from positions (k, 3) [m], velocities (k, 3) [m/s] and time [s] to (k, 3) [N/kg]
    rows     : (k,) owned nodes in its region
    mass     : (k,) their masses [kg]
    total    : factor of the function [-]
    """

    key: str
    function: ForceFunction
    rows: Indices
    mass: Floats
    total: Lines = field(default=ALWAYS, kw_only=True)

    def force_at(self, q: Positions, v: Rows, time: float) -> Rows:
        """Return the force (owned, 3) [N] at positions q and velocities v (owned, 3).

        Raises InputError if the function's result is no array of finite real numbers, or has a
        wrong shape.
        """
        force = np.zeros((len(q), 3))
        if not len(self.rows):
            return force
        # a user's function may divide by zero: the result is checked below
        with np.errstate(all="warn"):
            returned = self.function(q[self.rows], v[self.rows], time)
        try:
            per_mass = np.asarray(returned)
            is_real = per_mass.dtype.kind in "biuf"
        except ValueError:
            is_real = False
        if not is_real:
            words = f"returned {printable(repr(returned), 60)}, no array of real numbers"
            raise InputError(f"{self.key}.function: {words}")
        try:
            force[self.rows] = self.mass[:, None] * np.broadcast_to(per_mass, (len(self.rows), 3))
        except ValueError:
            words = f"returned numbers of shape {per_mass.shape}, not {(len(self.rows), 3)}"
            raise InputError(f"{self.key}.function: {words}") from None
        if not np.isfinite(force).all():
            raise InputError(
                f"{self.key}.function: returned numbers that are not finite (t = {time:.6g} s)"
            )
        return force


def shares_by_mass(comm: "MPI.Comm", where: Mask, mass: Floats) -> Rows:
    """Return each node's share (owned, 1) by mass of a force on ``where`` (owned,) (collective)."""
    loaded = np.where(where, mass, 0.0)
    share: Rows = loaded[:, None] / comm.allreduce(loaded.sum())
    return share


class ExternalForces(NamedTuple):
    """External forces at a time, or their means over an interval of time.

    force     : (owned, 3) [N] that do not depend on positions
    pressures : pressures, whose forces follow the surface
    totals    : total of each load of ``ActingForces.loads``
    """

    force: Rows
    pressures: Pressures
    totals: list[Floats]

    def at(self, q: Positions) -> Rows:
        """Return the force f_ext (owned, 3) [N] at positions q (l, 3) [m] (collective)."""
        if not self.pressures.parts:
            return self.force
        gradient = -self.force
        self.pressures.add_gradient(q, gradient)
        return -gradient


class ActingForces:
    """External forces on the nodes of a rank. Local positions (l, 3) [m] include ghosts."""

    def __init__(
        self,
        lattice: Lattice,
        loads: Sequence[Load],
        own_forces: Sequence[OwnForce],
        pressures: Sequence[PressureLoad] = (),
    ):
        self.lattice, self.loads, self.own_forces = lattice, loads, own_forces
        self.pressures = pressures
        self.all: list[Varying] = [*loads, *own_forces, *pressures]
        # Values of the users' functions as a step begins, and their changes since the
        # step before
        self._own: list[tuple[Rows, Rows]] = [(np.zeros((0, 3)),) * 2] * len(own_forces)

    def begin_step(
        self,
        q: Positions,
        v: Rows,
        time: float,
        earlier: tuple[Positions, Rows, float] | None = None,
    ) -> None:
        """Evaluate the users' force functions at the state at which a step begins.

        The forces stay constant within the step. So they are explicit, and their error is of first
        order in the time step. With a state one step earlier they are extrapolated to the end of
        the step, and the error is of second order.

        q, v    : positions (l, 3) [m] and velocities (l, 3) [m/s]
        time    : begin of the step [s]
        earlier : positions, velocities and time one step earlier

        Raises InputError if the result of a function has a wrong shape or is not finite.
        """
        owned = self.lattice.owned

        def own(force: OwnForce, q: Positions, v: Rows, time: float) -> Rows:
            return like(q, force.force_at(to_host(q[:owned]), to_host(v[:owned]), time))

        for number, force in enumerate(self.own_forces):
            now = own(force, q, v, time)
            before = now if earlier is None else own(force, *earlier)
            self._own[number] = now, now - before

    def at(self, time: float, users: bool = True) -> ExternalForces:
        """Return the external forces at a time [s].

        users : whether to include the users' functions, which have no potential
        """
        return self._with(lambda load: load.state_at(time), 1.0 if users else None)

    def mean(self, begin: float, end: float, reach: float = 1.0) -> ExternalForces:
        """Return the means of the external forces from begin to end [s].

        reach : time in which the users' functions go on changing, as they did in the step before
                [steps]: 1 as in the step, 1/2 for their mean over the step, which does their work
        """
        return self._with(lambda load: load.mean(begin, end), reach)

    def ahead(self, before: float, begin: float, end: float) -> ExternalForces:
        """Return (3 f - f') / 2: f is the mean from begin to end, f' from before to begin [s]."""

        def total(load: Varying) -> Floats:
            mean = load.mean(begin, end)
            return mean + 0.5 * (mean - load.mean(before, begin))

        return self._with(total)

    def _with(
        self, total: Callable[[Varying], Floats], reach: float | None = 1.0
    ) -> ExternalForces:
        """Return the external forces, with ``total(load)`` as the total of each load.

        reach : as in ``mean``; None to leave out the users' functions
        """
        force = np.zeros((self.lattice.owned, 3), like=self.lattice.nodes)
        totals = [total(load) for load in self.loads]
        for load, value in zip(self.loads, totals, strict=True):
            force += load.share * like(load.share, value)
        for function, (own, change) in zip(self.own_forces, self._own, strict=True):
            share = float(total(function)[0])
            if reach is not None and share and len(own):
                force = force + share * (own + reach * change)
        values = [float(total(pressure)[0]) for pressure in self.pressures]
        return ExternalForces(force, Pressures([p.part for p in self.pressures], values), totals)
