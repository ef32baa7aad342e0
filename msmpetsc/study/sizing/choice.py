"""Cheapest split of a surface error among cells and time step, and the resulting plan."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomlkit

from msmpetsc.results.disk import write_whole
from msmpetsc.scene.reading import read_toml
from msmpetsc.scene.time import STATIC
from msmpetsc.scene.toml import toml_value
from msmpetsc.scene.values import IntegratorName
from msmpetsc.study.cases import scene_tables
from msmpetsc.study.sizing.orders import ErrorLaw


@dataclass(frozen=True)
class Candidate:
    """An integrator with its time step [s] and, except for verlet, solver preset and step error."""

    integrator: IntegratorName
    time_step: float
    preset: str = ""
    step_error: float | None = None


@dataclass(frozen=True)
class Stepping:
    """A method tried on a coarse lattice: error of its time step [-], cost [s per simulated s]."""

    method: Candidate
    error: float
    cost: float


@dataclass(frozen=True)
class Budget:
    """The parts of a surface error, each relative to the largest displacement [-]."""

    cells: float
    time: float

    @property
    def total(self) -> float:
        """The sum of the parts, an upper bound of the surface error [-]."""
        return self.cells + self.time


@dataclass(frozen=True)
class Choice:
    """A run with its expected error and cost: computing time per simulated time [s/s]."""

    method: Candidate
    cells: int
    budget: Budget
    cost: float


@dataclass(frozen=True)
class CostModel:
    """Errors and costs of cells and time steps, extrapolated from the trials.

    law         : error of the cells over the edge of a cell, cells^(-1/3)
    cells       : number of cells of the lattice on which ``steppings`` were tried
    least, most : range of cells that may be chosen
    """

    law: ErrorLaw
    steppings: Sequence[Stepping]
    cells: float
    least: int
    most: int

    def cheapest(self, target: float) -> Choice | None:
        """Return the cheapest choice whose parts sum to at most ``target``, or None."""
        choices = [
            self.choice(stepping, cells)
            for stepping in self.steppings
            if (cells := self.cells_for(target - stepping.error)) <= self.most
        ]
        return min(choices, key=lambda choice: choice.cost, default=None)

    def best(self) -> Choice:
        """Return the choice of least error, at any cost."""
        return self.choice(min(self.steppings, key=lambda each: each.error), self.most)

    def cells_for(self, error: float) -> float:
        """Return the fewest cells whose error is at most ``error``; infinity for an error of 0."""
        if error <= 0:
            return math.inf
        if self.law.factor <= 0:
            return self.least
        return max(self.least, math.ceil(self.law.size(error) ** -3))

    def choice(self, stepping: Stepping, cells: float) -> Choice:
        """Return the choice of a method and a number of cells."""
        budget = Budget(self.law.error(cells ** (-1 / 3)), stepping.error)
        # verlet's substeps grow as 1 / edge
        order = 4 / 3 if stepping.method.integrator == "verlet" else 1
        cost = stepping.cost * (cells / self.cells) ** order
        return Choice(stepping.method, int(cells), budget, cost)


@dataclass(frozen=True)
class SizeTrial:
    """A trial run, with its cost and its result file.

    asked    : requested number of valid cells; ``cells`` is the lattice's number
    cost     : computing time per simulated time [s/s]
    substeps : mean number of substeps per step for verlet, of iterations otherwise
    inverted : number of cells that are inverted at the end
    """

    method: Candidate
    asked: int
    cells: float
    cost: float
    substeps: float
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


def size_bounds(model: CostModel, target: float, step_known: bool) -> list[str]:
    """Return a note each for time step and cells if its least error exceeds half the target."""
    bounds = []
    best = model.best().budget
    if best.time > target / 2 and not step_known:
        bounds.append(f"the step: {best.time:.1e} is left at the shortest step tried")
    if best.cells > target / 2:
        wanted = f"half the error asked for would take {model.cells_for(target / 2):.2g}"
        bounds.append(
            f"the mesh's cells: {best.cells:.1e} is left with {model.most} cells; {wanted}"
        )
    return bounds


def inverted_bound(trials: Sequence[SizeTrial], law: str) -> list[str]:
    """Return a note if cells of the finest lattice are inverted, because convergence may fail."""
    finest = max(trials, key=lambda each: each.cells)
    if not finest.inverted:
        return []
    helps = "fewer --frames"
    if law == "linear":
        helps += ' or material.law = "neo-hookean"'
    inverted = (
        f"of {finest.cells:.0f} cells {finest.inverted:.0f} end inside out, "
        "each lattice in its own way"
    )
    return [f"the motion: {inverted}; {helps} may help"]


# ---- the answer as changes of a scene file

# values by table and key of a scene file
Tables = Mapping[str, Mapping[str, Any]]


def tables(method: Candidate) -> Tables:
    """Return the tables of a scene that a method determines; None stands for no key."""
    values = vars(method) | {"substep": None, "error": method.step_error, "max_iterations": None}
    if method.integrator == STATIC:
        # a static scene needs no time step
        del values["time_step"]
    return scene_tables(values)


def overrides(scene: Path, tables: Tables) -> list[str]:
    """Return changes of a scene file as arguments of --set. Raises InputError."""
    _, document = read_toml(scene)
    changes = []
    for name, table in tables.items():
        given = document.get(name, {})
        if any(value is None and key in given for key, value in table.items()):
            # --set cannot remove a key, so the whole table is replaced
            changes.append(f"{name}={toml_value({**given, **table})}")
        else:
            changes += [
                f"{name}.{key}={value}" for key, value in table.items() if value is not None
            ]
    return changes


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
    # tomlkit may end new lines in another way
    write_whole(scene, tomlkit.dumps(document).replace("\r\n", "\n").replace("\n", line_end))
