"""Integrators of the equations of motion, by the name that a scene gives them (time.integrator)."""

from msmpetsc.solve.integrators.implicit import Bdf2, ImplicitEuler
from msmpetsc.solve.integrators.static import Static
from msmpetsc.solve.integrators.verlet import Verlet

Integrators = dict[str, type[ImplicitEuler] | type[Verlet]]
INTEGRATORS: Integrators = {"implicit-euler": ImplicitEuler, "bdf2": Bdf2, "verlet": Verlet, "static": Static}
