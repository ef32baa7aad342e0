"""The answer of a plan: trials, choice, what bounds the error, and changes of the scene."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomlkit

from msmpetsc.results.disk import write_whole
from msmpetsc.scene.reading import read_toml
from msmpetsc.scene.time import STATIC
from msmpetsc.study.cases import inline, scene_tables
from msmpetsc.study.sizing.choice import Candidate, Choice, CostModel


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
    bounds: list[str] = field(default_factory=list)  # what keeps the error from being smaller, or sure, in words
    tried: list[SizeTrial] = field(default_factory=list)


def size_bounds(model: CostModel, target: float, step_known: bool) -> list[str]:
    """Return which of step and cells leaves over half of the target at its finest."""
    bounds = []
    best = model.best().budget
    if best.time > target / 2 and not step_known:
        bounds.append(f"the step: {best.time:.1e} is left at the shortest step tried")
    if best.cells > target / 2:
        wanted = f"half the error asked for would take {model.cells_for(target / 2):.2g}"
        bounds.append(f"the mesh's cells: {best.cells:.1e} is left with {model.most} cells; {wanted}")
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
            changes.append(f"{name}={inline({**given, **table})}")  # --set changes keys, and takes none away
        else:
            changes += [f"{name}.{key}={value}" for key, value in table.items() if value is not None]
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
