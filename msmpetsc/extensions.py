"""Presets, forces and obstacles that users register in Python or install as entry points.

A scene file names an extension but never contains code.
"""

from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Any, Generic, TypeVar

from msmpetsc.backend.arrays import Floats, Positions, Rows
from msmpetsc.errors import InputError, did_you_mean

# positions (k, 3) [m] and velocities (k, 3) [m/s] of this rank's nodes in the region,
# time [s] -> force per mass (k, 3) [N/kg]
ForceFunction = Callable[[Positions, Rows, float], Rows]
# positions (k, 3) [m] in the obstacle's frame of time 0
# -> signed distances (k,) [m] and their gradients (k, 3)
DistanceFunction = Callable[[Positions], tuple[Floats, Rows]]
T = TypeVar("T")


class Extensions(Generic[T]):
    """Registry of the extensions of a kind; a registered name hides an installed extension.

    kind  : "force", "obstacle" or "preset"
    group : of the entry points, for example "msmpetsc.forces"
    """

    def __init__(self, kind: str):
        self.kind, self.group = kind, f"msmpetsc.{kind}s"
        self._registered: dict[str, T] = {}

    def register(self, name: str, value: T) -> None:
        """Register a value under a name that scenes may then use. Call it on all ranks.

        Parameters
        ----------
        name : str
            Name in scene files. A value registered before under this name is replaced.
        value
            For a force, f(x, v, t) -> force per mass (k, 3) [N/kg], with positions x (k, 3) [m]
            and velocities v (k, 3) [m/s] of this rank's nodes and the time t [s].
            For an obstacle, f(x) -> signed distances (k,) [m], negative inside, and their
            gradients (k, 3).
        """
        self._registered[name] = value

    def names(self) -> list[str]:
        """Return all registered and installed names without importing any extension."""
        return [*self._registered, *(point.name for point in entry_points(group=self.group))]

    def find(self, name: str) -> T:
        """Return the value of a name; import an installed extension.

        Raises InputError if the name is unknown, or the extension cannot be imported.
        """
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
        # third-party code may raise anything on import
        except Exception as error:
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
    """Register PETSc options as a preset for ``solver.preset``. Call it on all ranks.

    Parameters
    ----------
    name : str
        Name of the preset.
    options : mapping
        PETSc options without the dash, for example {"ksp_rtol": 1e-4}. An option without a value
        has None or True.
    based_on : str
        Built-in preset whose method and other options stay as they are.
    about : str
        When to use the preset, for ``--list-presets``.
    """
    PRESETS.register(name, {"options": options, "based_on": based_on, "about": about})
