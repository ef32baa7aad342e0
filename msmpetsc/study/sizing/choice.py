"""The choice of a plan: integrator, target errors and cells; and the scene file that gets them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomlkit

from msmpetsc.results.disk import write_whole
from msmpetsc.scene.reading import read_toml
from msmpetsc.scene.toml import toml_value
from msmpetsc.scene.values import IntegratorName


@dataclass(frozen=True)
class PlannedMethod:
    """An integrator with the target errors of its motion and of its steps; None for no target."""

    integrator: IntegratorName
    time_error: float | None = None
    step_error: float | None = None


@dataclass(frozen=True)
class Budget:
    """The surface error of the cells and of the time steps, over the largest displacement [-]."""

    cells: float
    time: float

    @property
    def total(self) -> float:
        """The sum of the parts, an upper bound of the surface error [-]."""
        return self.cells + self.time


@dataclass(frozen=True)
class Choice:
    """A run that may be chosen, with its expected error and cost.

    cost : computing time per simulated time [s/s]
    """

    method: PlannedMethod
    cells: int
    budget: Budget
    cost: float


@dataclass(frozen=True)
class SizeTrial:
    """A trial run, with its cost and its result file.

    asked    : requested number of valid cells; ``cells`` is the lattice's number
    cost     : computing time per simulated time [s/s]
    inverted : number of cells that are inverted at the end
    """

    method: PlannedMethod
    asked: int
    cells: float
    cost: float
    inverted: float
    result: Path

    @property
    def edge(self) -> float:
        """Edge of a cell, relative to the edge of a body of a single cell [-]."""
        return float(self.cells ** (-1 / 3))


@dataclass
class SizePlan:
    """The choice of a plan, and the limits of its error.

    choice : cheapest run that meets the error, or else the run of least error
    met    : whether the run is expected to meet the error
    bounds : reasons why the error is not smaller, or not certain
    """

    choice: Choice
    met: bool
    bounds: list[str] = field(default_factory=list)
    tried: list[SizeTrial] = field(default_factory=list)


# ---- the answer as changes of a scene file

# values by table and key of a scene file
Tables = Mapping[str, Mapping[str, Any]]


def tables(method: PlannedMethod) -> dict[str, dict[str, Any]]:
    """Return the scene's tables that a method determines; a key of value None is to be removed."""
    time = {"integrator": method.integrator, "error": method.time_error, "substep": None}
    if method.integrator == "verlet":
        return {"time": time}
    # the preset chooses the preconditioner itself
    solver = {"preset": "newton", "error": method.step_error, "max_iterations": None}
    return {"time": time, "solver": solver}


def overrides(scene: Path, tables: Tables) -> list[str]:
    """Return changes of a scene file as arguments of --set. Raises InputError."""
    document = read_toml(scene)
    # --set cannot remove a key, so whole tables are replaced
    return [
        f"{name}={toml_value({**document.get(name, {}), **table})}"
        for name, table in tables.items()
    ]


def put_into(scene: Path, tables: Tables) -> None:
    """Write changes into a scene file, keeping comments, order and line ends. Raises InputError."""
    text = scene.read_bytes().decode()
    line_end = "\r\n" if "\r\n" in text else "\n"
    document = tomlkit.parse(text)
    for name, table in tables.items():
        if name not in document:
            document[name] = tomlkit.table()
        old: Any = document[name]
        for key, value in table.items():
            if value is None:
                old.pop(key, None)
            elif old.get(key) != value:
                old[key] = value
    # tomlkit may give new lines another line end
    write_whole(scene, tomlkit.dumps(document).replace("\r\n", "\n").replace("\n", line_end))
