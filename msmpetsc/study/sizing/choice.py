"""The cheapest split of a surface error among cells, step and solution, and the plan that it makes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from msmpetsc.results.disk import write_whole
from msmpetsc.scene.reading import read_toml
from msmpetsc.scene.time import STATIC
from msmpetsc.scene.toml import toml_value
from msmpetsc.scene.values import IntegratorName
from msmpetsc.study.cases import scene_tables
from msmpetsc.study.sizing.orders import ErrorLaw

STEEPEST = 1.6  # power of the cells that the cost of a step goes by, at most: what is more is the noise of a clock


@dataclass(frozen=True)
class Candidate:
    """A way to step a scene; explicit steps have no preset and no error."""

    integrator: IntegratorName
    time_step: float  # [s]
    preset: str = ""
    step_error: float | None = None


@dataclass(frozen=True)
class Stepping:
    """An integrator with its step, tried on one lattice."""

    method: Candidate
    error: float  # of the time step alone [-]
    cost: float  # computing seconds a simulated second there


@dataclass(frozen=True)
class Solving:
    """A target of the relative error of a step, with what it leaves and costs."""

    step_error: float | None
    error: float  # that it leaves in the motion [-]
    cost: float  # over that of the trials


@dataclass(frozen=True)
class Budget:
    """The parts of a surface error, each relative to the largest displacement [-]; their sum is never exceeded."""

    cells: float
    time: float
    step: float

    @property
    def total(self) -> float:
        return self.cells + self.time + self.step


@dataclass(frozen=True)
class Choice:
    """A run, with its expected error and cost."""

    method: Candidate
    cells: int
    budget: Budget
    cost: float  # computing seconds a simulated second


@dataclass(frozen=True)
class CostModel:
    """Errors of cells, steps and their solution as the trials showed them, and their costs."""

    law: ErrorLaw  # of the error over the edge of a cell, cells^(-1/3)
    steppings: Sequence[Stepping]
    solvings: Sequence[Solving]
    cells: float  # of the lattice that the steppings were tried on
    costs: Sequence[
        tuple[float, float]
    ]  # of one of them by the cells of the lattices tried, ascending
    explicit: bool  # whether that one was explicit, whose substeps shorten as the edge of a cell
    least: int  # cells that may be chosen
    most: int

    def cheapest(self, target: float) -> Choice | None:
        """Return the cheapest choice whose errors add up to the target at most, or None."""
        choices = [
            self.choice(stepping, solving, cells)
            for stepping in self.steppings
            for solving in self._solvings(stepping)
            if (cells := self.cells_for(target - stepping.error - solving.error)) <= self.most
        ]
        return min(choices, key=lambda choice: choice.cost, default=None)

    def best(self) -> Choice:
        """Return the choice of the least error, whatever it costs."""
        stepping = min(self.steppings, key=lambda each: each.error)
        solving = min(self._solvings(stepping), key=lambda each: each.error)
        return self.choice(stepping, solving, self.most)

    def cells_for(self, error: float) -> float:
        """Return the number of cells that has this error; infinity for an error of 0."""
        if error <= 0:
            return math.inf
        return (
            max(self.least, math.ceil(self.law.size(error) ** -3))
            if self.law.factor > 0
            else self.least
        )

    def choice(self, stepping: Stepping, solving: Solving, cells: float) -> Choice:
        budget = Budget(self.law.error(cells ** (-1 / 3)), stepping.error, solving.error)
        shorter = (
            stepping.method.integrator == "verlet"
        ) - self.explicit  # substeps, than those of the costs known
        growth = self.growth(self.cells, cells) * (cells / self.cells) ** (shorter / 3)
        cost = stepping.cost * solving.cost * growth
        method = replace(stepping.method, step_error=solving.step_error)
        return Choice(method, int(cells), budget, cost)

    def growth(self, before: float, after: float) -> float:
        """Return the ratio of the costs of two numbers of cells, interpolated between the lattices tried."""
        cells, costs = np.log(self.costs).T
        if len(cells) < 2:
            return after / before
        slopes = np.clip(np.diff(costs) / np.diff(cells), 0.0, STEEPEST)
        knots = np.concatenate([[0.0], np.cumsum(slopes * np.diff(cells))])
        ends = np.log([before, after])
        past = np.maximum(0.0, ends - cells[-1])  # where nothing was tried
        start, end = np.interp(ends, cells, knots) + max(1.0, slopes[-1]) * past
        return math.exp(end - start)

    def _solvings(self, stepping: Stepping) -> Sequence[Solving]:
        """Return the step errors that may be chosen; explicit steps have none."""
        return (
            [Solving(None, 0.0, 1.0)] if stepping.method.integrator == "verlet" else self.solvings
        )


@dataclass(frozen=True)
class SizeTrial:
    """A run with its cost and its result."""

    method: Candidate
    asked: int  # valid cells
    cells: float  # that it had
    cost: float  # computing seconds a simulated second
    substeps: float  # of a step, for verlet; else iterations; their mean
    inverted: float  # cells that end inside out
    result: Path

    @property
    def edge(self) -> float:
        """Edge of a cell, relative to that of a body of one cell."""
        return float(self.cells ** (-1 / 3))


@dataclass
class SizePlan:
    """The choice of a plan, and what bounds its error."""

    choice: Choice  # the cheapest that meets the error, or of the smallest error there is
    met: bool  # whether it is expected to meet the error
    bounds: list[str] = field(
        default_factory=list
    )  # what keeps the error from being smaller, or sure, in words
    tried: list[SizeTrial] = field(default_factory=list)


def size_bounds(model: CostModel, target: float, step_known: bool) -> list[str]:
    """Return which of step and cells leaves over half of the target at its finest."""
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
    """Return a note if cells of the finest lattice end inverted: such a motion need not converge."""
    finest = max(trials, key=lambda each: each.cells)
    if not finest.inverted:
        return []
    helps = "fewer --frames"
    if law == "linear":
        helps += ' or material.law = "neo-hookean"'
    inverted = f"of {finest.cells:.0f} cells {finest.inverted:.0f} end inside out, each lattice in its own way"
    return [f"the motion: {inverted}; {helps} may help"]


# The answer as changes of a scene file

Tables = Mapping[str, Mapping[str, Any]]  # of a scene file, by name and key


def tables(method: Candidate) -> Tables:
    """Return the tables of a scene that a method sets; a key that is None is absent."""
    values = vars(method) | {"substep": None, "error": method.step_error, "max_iterations": None}
    if method.integrator == STATIC:
        del values["time_step"]  # which spaces states, and need not stand there
    return scene_tables(values)


def overrides(scene: Path, tables: Tables) -> list[str]:
    """Return the changes of a scene file as overrides of --set. Raises InputError."""
    (_, document), changes = read_toml(scene), []
    for name, table in tables.items():
        given = document.get(name, {})
        if any(value is None and key in given for key, value in table.items()):
            changes.append(
                f"{name}={toml_value({**given, **table})}"
            )  # --set changes keys, and takes none away
        else:
            changes += [
                f"{name}.{key}={value}" for key, value in table.items() if value is not None
            ]
    return changes


def put_into(scene: Path, tables: Tables) -> None:
    """Change a scene file, keeping its comments and order. Raises InputError."""
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
    # new lines end like the others
    write_whole(scene, tomlkit.dumps(document).replace("\r\n", "\n").replace("\n", line_end))
