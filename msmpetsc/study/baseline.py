"""Numbers of a scene that are stored, and held against those of a later run.

Each step is solved to 1e-9, so that neither the number of ranks nor the way in which a step is
solved shows. Counts must be equal, the numbers of the last frame within the tolerance.

Tolerance. A step solved to the relative error e leaves e |x* - y| in x, |x* - y| being at most about the largest
displacement D. What goes on from there carries it along in y = 2 q_n - q_(n-1): after N steps it is e D N (N + 1) / 2.
Ten times as much is allowed, for contact and buckling make differences grow; twice that in energies and momentum, in
which errors of x count double. Positions are relative to D, energies to the largest of the run (the potential one
counted from the start), momentum to that of the whole mass at the largest kinetic energy.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

import msmpetsc
from msmpetsc.errors import InputError, printable
from msmpetsc.results.disk import write_whole
from msmpetsc.study.cases import launcher
from msmpetsc.study.forkserver import COLD
from msmpetsc.study.process import Processes

ERROR = 1e-9  # of each step, relative
LONGEST = 1e6  # [s] of a run
GROWTH = 10  # of an error, by contact and buckling
ENERGIES = ("kinetic", "elastic", "potential", "contact")
NODES = 5  # whose places are stored, evenly spread by their numbers
HEAD = f"{'scene':20} {'cells':>6} {'nodes':>6} {'springs':>8} {'off by':>9} {'allowed':>9} {'time':>7}"
Unit = Literal["m", "J", "kg m/s"]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Size = Annotated[float, Field(ge=0, allow_inf_nan=False)]
MOST_STEPS = int((2 / (GROWTH * ERROR)) ** 0.5)  # with more, any difference would be allowed


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, populate_by_name=True)


class Recipe(_Strict):
    """How a scene is run for its numbers."""

    cells: Annotated[int, Field(ge=1)] | None = Field(  # the scene's own if None
        validation_alias="cells asked for", serialization_alias="cells asked for"
    )
    error: float = ERROR
    steps: int = Field(ge=1, le=MOST_STEPS)  # from the start
    changes: list[str] = []  # of the scene, as --set takes them


class Number(_Strict):
    """A number of the last frame, or a vector."""

    unit: Unit
    value: Finite | list[Finite]

    def __str__(self) -> str:
        return f"{np.array2string(np.asarray(self.value), precision=9)} {self.unit}"


class Numbers(_Strict):
    """What is stored of a run; scales: what errors are relative to. A file of them may be damaged, or from anywhere."""

    run: Recipe
    counts: dict[str, Annotated[int, Field(ge=0)]]
    scales: dict[Unit, Size]
    numbers: dict[str, Number]


def simulate(scene: Path, recipe: Recipe, path: Path, ranks: int) -> None:
    """Run a scene by its recipe into a result file. Raises InputError with the last line where the run fails."""
    cells = [] if recipe.cells is None else [f"cages.count={recipe.cells}"]
    options = [*cells, "output.surface=false", *recipe.changes]
    words = ["run", scene, "-o", path, "--overwrite", "--frames", recipe.steps, "--error", ERROR]
    words += [word for option in options for word in ("--set", option)]
    ended = Processes().run([*launcher(ranks), *COLD, *map(str, words)], path.with_suffix(".log"), LONGEST)
    if ended.reason:
        raise InputError(f"{scene}: the run failed: {ended.reason}")


def summary(path: Path, recipe: Recipe) -> Numbers:
    """Return what is stored of a run: its recipe, counts, what errors are relative to, the last frame's numbers."""
    with msmpetsc.open(path) as result:
        lattice, frames = result.lattice, result.frames
        rest, mass = lattice.nodes[:], lattice.mass[:]
        moved = max(np.linalg.norm(q - rest, axis=1).max() for q in frames.position)
        energies, q = {name: frames[name][:] for name in ENERGIES}, frames.position[-1]
        counts = {name: len(lattice[name]) for name in ("cells", "nodes", "springs", "pinned")}
        counts["frames"] = len(frames.time)
        momentum = frames.momentum[-1]
    some = np.linspace(0, len(q) - 1, NODES).astype(int)
    ends: dict[str, tuple[Unit, Any]] = {name: ("J", values[-1]) for name, values in energies.items()}
    ends |= {"momentum": ("kg m/s", momentum), "centre of mass": ("m", mass @ q / mass.sum())}
    ends |= {"lowest corner": ("m", q.min(axis=0)), "highest corner": ("m", q.max(axis=0))}
    ends |= {f"node {node}": ("m", q[node]) for node in some}
    energies["potential"] -= energies["potential"][0]
    scales: dict[Unit, float] = {
        "m": float(moved),
        "J": float(max(np.abs(values).max() for values in energies.values())),
        "kg m/s": float(np.sqrt(2 * mass.sum() * energies["kinetic"].max())),
    }
    numbers = {
        name: Number.model_construct(unit=unit, value=np.asarray(value).tolist())
        for name, (unit, value) in ends.items()
    }
    return Numbers.model_construct(run=recipe, counts=counts, scales=scales, numbers=numbers)


def allowed(steps: int, unit: str) -> float:
    """Return the relative difference that the errors of so many steps may come to."""
    return GROWTH * ERROR * steps * (steps + 1) / 2 * (1 if unit == "m" else 2)


def differences(found: Numbers, stored: Numbers) -> Iterator[tuple[str, float, float]]:
    """Yield of each number its name, how far it is off, relative, and how much is allowed."""
    for name in found.numbers.keys() | stored.numbers.keys():
        one, other = found.numbers.get(name), stored.numbers.get(name)
        if one is None or other is None or one.unit != other.unit or np.shape(one.value) != np.shape(other.value):
            yield name, np.inf, 0.0
            continue
        apart = np.abs(np.subtract(one.value, other.value, dtype=float)).max()
        scale = min(found.scales[one.unit], stored.scales[one.unit])  # of a damaged file any
        relative = np.inf
        if apart == 0:
            relative = 0.0
        elif scale > 0 and np.isfinite(apart):
            relative = float(apart / scale)
        yield name, relative, allowed(stored.run.steps, one.unit)


def judged(found: Numbers, stored: Numbers) -> dict[str, str]:
    """Return for each count and number what is wrong with it, nothing for what is as stored."""
    lines = {}
    for name in found.counts.keys() | stored.counts.keys():
        now, then = found.counts.get(name), stored.counts.get(name)
        lines[name] = "" if now == then else f"{name}: {now}, stored {then}"
    for name, off, most in differences(found, stored):
        values = f"{found.numbers.get(name, 'not there')}, stored {stored.numbers.get(name, 'not there')}"
        lines[name] = f"{name}: {values}: {off:.2g} off, {most:.2g} allowed" if off > most else ""
    return dict(sorted(lines.items()))


def row(name: str, found: Numbers, stored: Numbers, seconds: float, verdict: str) -> str:
    """Return the line of a scene under HEAD, with the number that comes nearest to what is allowed of it."""
    _, off, most = max(differences(found, stored), key=lambda row: row[1] / row[2] if row[2] else np.inf)
    sizes = f"{found.counts['cells']:6} {found.counts['nodes']:6} {found.counts['springs']:8}"
    return f"{name:20} {sizes} {off:9.1e} {most:9.1e} {seconds:5.1f} s {verdict}"


def write(path: Path, numbers: Numbers) -> None:
    """Store numbers. Raises InputError."""
    write_whole(path, json.dumps(numbers.model_dump(by_alias=True), indent=1) + "\n")


def read(path: Path) -> Numbers:
    """Return stored numbers. Raises InputError for what are none."""
    try:
        stored = Numbers.model_validate_json(path.read_text(encoding="utf-8"))
        judged(stored, stored)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = printable(".".join(map(str, first["loc"])) or "all", 60)
        raise InputError(f"{path} is damaged, or has no numbers of a scene: {where}: {first['msg']}") from None
    except (ValueError, LookupError):
        raise InputError(f"{path} is damaged, or has no numbers of a scene") from None
    return stored
