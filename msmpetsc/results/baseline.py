"""Stored numbers of a run, and the tolerance within which a later run must agree with them.

Each step is solved to 1e-9, so that the number of ranks and the solver do not matter. Counts
must be equal, and the numbers of the last frame must agree within the tolerance.

A step solved to the relative error e leaves an error e |x* - y| in x. The distance |x* - y| is at
most about the largest displacement D. Through y = 2 q_n - q_(n-1) the errors add up to
e D N (N + 1) / 2 after N steps. The tolerance is 10 times this sum, because contact and buckling
amplify differences. It is twice as large for energies and momentum, which double the relative
error of x. The tolerance is relative to a scale for each unit:

- positions: D
- energies: the largest energy of the run, with potential energy relative to the start
- momentum: sqrt(2 m E), m the whole mass and E the largest kinetic energy
"""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from msmpetsc.errors import InputError, printable
from msmpetsc.results.comparison import ENERGIES
from msmpetsc.results.disk import write_whole
from msmpetsc.results.reader import Result

# relative error of each step [-]; so that solver and ranks make no difference
ERROR = 1e-9
# allowed growth of an error by contact and buckling [-]
GROWTH = 10
# number of nodes whose positions are stored, evenly spaced in the numbering [-]
NODES = 5
Unit = Literal["m", "J", "kg m/s"]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Size = Annotated[float, Field(ge=0, allow_inf_nan=False)]
# largest number of steps [-]; with more steps any difference would be allowed
MOST_STEPS = int((2 / (GROWTH * ERROR)) ** 0.5)


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, populate_by_name=True)


class Recipe(_Strict):
    """The options of the run that gives the numbers of a scene.

    cells   : cages.count; None for the scene's own
    steps   : number of steps from the start
    changes : changes of the scene as values of ``--set``
    """

    cells: Annotated[int, Field(ge=1)] | None = Field(
        validation_alias="cells asked for", serialization_alias="cells asked for"
    )
    steps: int = Field(ge=1, le=MOST_STEPS)
    changes: list[str] = []


class Number(_Strict):
    """A number or a vector of the last frame, with its unit."""

    unit: Unit
    value: Finite | list[Finite]

    def __str__(self) -> str:
        return f"{np.array2string(np.asarray(self.value), precision=9)} {self.unit}"


class Numbers(_Strict):
    """The stored content of a run: recipe, counts, scales of errors, numbers of the last frame."""

    run: Recipe
    counts: dict[str, Annotated[int, Field(ge=0)]]
    scales: dict[Unit, Size]
    numbers: dict[str, Number]


def summary(path: Path, recipe: Recipe) -> Numbers:
    """Return the numbers to store for a result file."""
    with Result(path) as result:
        lattice = result.lattice
        frames = result.frames
        rest = lattice.nodes[:]
        mass = lattice.mass[:]
        displacement = max(np.linalg.norm(q - rest, axis=1).max() for q in frames.position)
        energies = {name: frames[name][:] for name in ENERGIES}
        q = frames.position[-1]
        counts = {name: len(lattice[name]) for name in ("cells", "nodes", "springs", "pinned")}
        counts["frames"] = len(frames.time)
        momentum = frames.momentum[-1]
    nodes = np.linspace(0, len(q) - 1, NODES).astype(int)
    ends: dict[str, tuple[Unit, Any]] = {
        name: ("J", values[-1]) for name, values in energies.items()
    }
    ends |= {"momentum": ("kg m/s", momentum), "centre of mass": ("m", mass @ q / mass.sum())}
    ends |= {"lowest corner": ("m", q.min(axis=0)), "highest corner": ("m", q.max(axis=0))}
    ends |= {f"node {node}": ("m", q[node]) for node in nodes}
    energies["potential"] -= energies["potential"][0]
    scales: dict[Unit, float] = {
        "m": float(displacement),
        "J": float(max(np.abs(values).max() for values in energies.values())),
        "kg m/s": float(np.sqrt(2 * mass.sum() * energies["kinetic"].max())),
    }
    numbers = {
        name: Number.model_construct(unit=unit, value=np.asarray(value).tolist())
        for name, (unit, value) in ends.items()
    }
    return Numbers.model_construct(run=recipe, counts=counts, scales=scales, numbers=numbers)


def allowed(steps: int, unit: str) -> float:
    """Return the allowed relative difference after a number of steps."""
    return GROWTH * ERROR * steps * (steps + 1) / 2 * (1 if unit == "m" else 2)


# values that overflow are reported as different
@np.errstate(all="ignore")
def differences(now: Numbers, stored: Numbers) -> list[tuple[str, float, float]]:
    """Return name, relative difference and allowed difference of each number."""
    rows = []
    for name in now.numbers.keys() | stored.numbers.keys():
        number = now.numbers.get(name)
        expected = stored.numbers.get(name)
        if number is None or expected is None or np.shape(number.value) != np.shape(expected.value):
            rows.append((name, np.inf, 0.0))
            continue
        difference = np.abs(np.subtract(number.value, expected.value, dtype=float)).max()
        # a damaged file may hold any scale
        scale = min(now.scales[number.unit], stored.scales[number.unit])
        relative = float(np.divide(difference, scale)) if difference else 0.0
        rows.append((name, relative, allowed(stored.run.steps, number.unit)))
    return rows


def judged(now: Numbers, stored: Numbers) -> list[str]:
    """Return a line for each count and number that differs from its stored value."""
    lines = [
        f"{name}: {now.counts.get(name)}, stored {stored.counts.get(name)}"
        for name in now.counts.keys() | stored.counts.keys()
        if now.counts.get(name) != stored.counts.get(name)
    ]
    for name, difference, tolerance in differences(now, stored):
        if difference > tolerance:
            value = now.numbers.get(name, "missing")
            expected = stored.numbers.get(name, "missing")
            lines.append(
                f"{name}: {value}, stored {expected}: {difference:.2g} off, {tolerance:.2g} allowed"
            )
    return sorted(lines)


def write(path: Path, numbers: Numbers) -> None:
    """Write numbers to a file. Raises InputError."""
    write_whole(path, json.dumps(numbers.model_dump(by_alias=True), indent=1) + "\n")


def read(path: Path) -> Numbers:
    """Return the numbers of a file. Raises InputError for a damaged file."""
    try:
        stored = Numbers.model_validate_json(path.read_text(encoding="utf-8"))
        judged(stored, stored)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = printable(".".join(map(str, first["loc"])) or "all", 60)
        raise InputError(
            f"{path} is damaged, or has no numbers of a scene: {where}: {first['msg']}"
        ) from None
    except (ValueError, LookupError):
        raise InputError(f"{path} is damaged, or has no numbers of a scene") from None
    return stored
