"""What users add by name: presets, forces and obstacles, registered in Python or installed under an entry point.

A scene file can only name what was registered or installed: nothing in a file is run.
"""

from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Any, Generic, TypeVar

from msmpetsc.backend.arrays import Floats, Positions, Rows
from msmpetsc.errors import InputError, did_you_mean

# positions (k, 3) [m] and velocities (k, 3) [m/s] of this rank's nodes in the region, time [s] -> (k, 3) [N/kg]
ForceFunction = Callable[[Positions, Rows, float], Rows]
# positions (k, 3) [m], at the obstacle's place at time 0 -> signed distances (k,) [m], and their gradients (k, 3)
DistanceFunction = Callable[[Positions], tuple[Floats, Rows]]
T = TypeVar("T")


class Extensions(Generic[T]):
    """Everything of one kind by its name; what is registered comes before what is installed.

    group : of the entry points, "msmpetsc.forces"
    """

    def __init__(self, kind: str):
        self.kind, self.group = kind, f"msmpetsc.{kind}s"
        self._registered: dict[str, T] = {}

    def register(self, name: str, value: T) -> None:
        """Give a value a name that scenes then mean, in place of the one before; on all ranks."""
        self._registered[name] = value

    def names(self) -> list[str]:
        """Return all names, without importing what is installed."""
        return [*self._registered, *(point.name for point in entry_points(group=self.group))]

    def find(self, name: str) -> T:
        """Return the value of a name, imported where it is installed. Raises InputError."""
        if name in self._registered:
            return self._registered[name]
        points = entry_points(group=self.group, name=name)
        if not points:
            near = did_you_mean(name, self.names())
            raise InputError(
                f"no {self.kind} {name!r} is registered, or installed under {self.group}{near}"
            )
        try:
            value: T = next(iter(points)).load()
        except Exception as error:  # of whatever was installed
            raise InputError(
                f"the {self.kind} {name!r} that is installed cannot be imported: {error}"
            ) from error
        return value


FORCES: Extensions[ForceFunction] = Extensions("force")
OBSTACLES: Extensions[DistanceFunction] = Extensions("obstacle")
PRESETS: Extensions[Mapping[str, Any]] = Extensions("preset")

register_force = FORCES.register
register_obstacle = OBSTACLES.register


def register_preset(
    name: str, options: Mapping[str, Any], based_on: str = "newton", about: str = ""
) -> None:
    """Give PETSc options a name, which ``solver.preset`` and ``preset=`` then mean; on all ranks.

    options  : {"ksp_rtol": 1e-4, ...}, without the dash; None or True for one without a value
    based_on : a preset that the program has, whose method and other options stay
    about    : when to use it, for ``--list-presets``
    """
    PRESETS.register(name, {"options": options, "based_on": based_on, "about": about})
