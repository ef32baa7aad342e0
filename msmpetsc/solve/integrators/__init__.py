"""Integrators of the equations of motion, by the name that a scene gives them (time.integrator)."""

from mpi4py import MPI

from msmpetsc.environment import Environment
from msmpetsc.scene.schema import Solver
from msmpetsc.scene.time import Time
from msmpetsc.solve.instrumentation import Probes
from msmpetsc.solve.integrators.implicit import Bdf2, ImplicitEuler
from msmpetsc.solve.integrators.integrator import Integrator
from msmpetsc.solve.integrators.static import Static
from msmpetsc.solve.integrators.verlet import Verlet

Integrators = dict[str, type[ImplicitEuler] | type[Verlet]]
INTEGRATORS: Integrators = {"implicit-euler": ImplicitEuler, "bdf2": Bdf2, "verlet": Verlet, "static": Static}


def make_integrator(
    comm: MPI.Comm, environment: Environment, time: Time, solver: Solver, probes: Probes = Probes(), prefix: str = ""
) -> Integrator:
    """Return the integrator that a scene's tables ``time`` and ``solver`` ask for (collective).

    probes : what is to be measured of its steps
    prefix : of its PETSc options

    Raises InputError for PETSc options that do not go together, and for probes that it has nothing for.
    """
    return INTEGRATORS[time.integrator](comm, environment, time, solver, probes, prefix)
