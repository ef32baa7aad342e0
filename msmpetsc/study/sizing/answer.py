"""What a plan of a surface error tells: its trials, its answer, and what keeps the error from being smaller."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import tomlkit

from msmpetsc.errors import InputError
from msmpetsc.results.disk import write_whole
from msmpetsc.scene.reading import read_toml
from msmpetsc.scene.statics import STATIC
from msmpetsc.study.cases import inline, scene_tables
from msmpetsc.study.sizing.choice import Candidate, Choice, CostModel


@dataclass(frozen=True)
class SizeTrial:
    """A run that was made.

    asked, cells : valid cells asked for, and had
    cost         : computing seconds a simulated second
    substeps     : of a step, for verlet; else iterations; their mean
    inverted     : cells that end inside out
    result       : its file
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
        """Edge of a cell, of a body of one cell."""
        return self.cells ** (-1 / 3)


class Tried(NamedTuple):
    """A trial as a point over cost and expected error."""

    method: str
    cells: float
    cost: float
    error: float


@dataclass
class SizePlan:
    """The answer.

    choice : the cheapest that meets the error, or of the smallest error there is
    met    : whether it is expected to meet the error
    bounds : what keeps the error from being smaller, or the estimate from being sure, in words
    """

    choice: Choice
    met: bool
    bounds: list[str] = field(default_factory=list)
    tried: list[Tried] = field(default_factory=list)


def size_bounds(model: CostModel, target: float, step_known: bool) -> list[str]:
    """Return what an error out of reach is made of: more than half of it by the step, or by the cells.

    step_known : whether what is wrong with the step is said already
    """
    bounds, best, wanted = [], model.best().budget, model.cells_for(target / 2)
    if best.time > target / 2 and not step_known:
        bounds.append(f"the step: {best.time:.1e} is left at the shortest step tried")
    if best.cells > target / 2:
        bounds.append(
            f"the mesh's cells: {best.cells:.1e} is left with {model.most} cells; half the error asked for "
            f"would take {wanted:.2g}"
        )
    return bounds


def fewest_bound(choice: Choice, coarser: Sequence[tuple[int, float]]) -> list[str]:
    """Return why a choice of so small an error has no fewer cells.

    coarser : cells and error of the finest lattice that is too coarse, if there is one
    """
    why = "no lattice of fewer can be run"
    for cells, error in coarser:
        why = f"{cells} cells have {error:.1e}, nothing was found between"
    return [f"the fewest cells: {choice.budget.total:.1e} is less than was asked for; {why}"]


def inverted_bound(inverted: float, cells: float, law: str) -> list[str]:
    """Return that cells of the finest lattice tried end inside out, if any do: such a motion need not converge.

    law : of the material
    """
    if not inverted:
        return []
    helps = "" if law == "stiffening" else ' or material.law = "stiffening"'
    return [
        f"the motion: of {cells:.0f} cells {inverted:.0f} end inside out, each lattice in its own way; fewer --frames"
        f"{helps} may help"
    ]


def time_bound(model: CostModel, target: float, times: Sequence[float], apart: Callable[[float], float]) -> list[str]:
    """Return until when an error out of reach would be within it; nothing if it is so at none of the times [s].

    apart : distance of the finest two lattices up to a time; the error of the cells is taken to go with it
    """
    best, whole = model.best().budget, apart(math.inf)
    for time in sorted(times, reverse=True):
        try:
            error = best.cells * apart(time) / whole + best.time + best.step
        except InputError:  # nothing moves so early
            break
        if error <= target:
            return [f"the motion: {error:.1e} would be left if it ended at {time:.3g} s: fewer --frames"]
    return []


# The answer as lines of a scene file

Tables = Mapping[str, Mapping[str, Any]]  # of a scene file, by name and key


def tables(method: Candidate) -> Tables:
    """Return what the method says of a scene; None: the key must not stand there."""
    values = {
        "integrator": method.integrator, "time_step": method.time_step, "substep": None, "preset": method.preset,
        "error": method.step_error, "max_iterations": None,
    }  # fmt: skip
    if method.integrator == STATIC:
        del values["time_step"]  # which spaces states, and need not stand there
    return scene_tables(values)


def lines(tables: Tables) -> str:
    """Return TOML lines to paste."""
    shown = {name: {key: value for key, value in table.items() if value is not None} for name, table in tables.items()}
    return tomlkit.dumps(shown).strip()


def overrides(scene: Path, tables: Tables) -> list[str]:
    """Return the same as changes of the scene file, as --set takes them. Raises InputError for a file not TOML."""
    (_, document), changes = read_toml(scene), []
    for name, table in tables.items():
        given = document.get(name, {})
        if any(value is None and key in given for key, value in table.items()):
            changes.append(f"{name}={inline({**given, **table})}")  # --set changes keys, and takes none away
        else:
            changes += [f"{name}.{key}={value}" for key, value in table.items() if value is not None]
    return changes


def put_into(scene: Path, tables: Tables) -> None:
    """Change the scene file; comments, order and all else stay as they are. Raises InputError."""
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
