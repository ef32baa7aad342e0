"""``msmpetsc check``: compare the numbers of a scene with numbers that ``--update`` has stored.

Each step is solved to 1e-9, so that the number of ranks and the solver do not matter. Counts
must be equal, and the numbers of the last frame must agree within a tolerance.

Tolerance: a step solved to the relative error e leaves an error e |x* - y| in x. The distance
|x* - y| is at most about the largest displacement D. Through y = 2 q_n - q_(n-1) the errors add
up to e D N (N + 1) / 2 after N steps. The tolerance is 10 times this sum, as contact and buckling
amplify differences. It is twice as large for energies and momentum, which double the relative
error of x. The tolerance is relative to a scale for each unit:

- positions: D
- energies: the largest energy of the run, with potential energy relative to the start
- momentum: sqrt(2 m E), m the whole mass and E the largest kinetic energy
"""

import argparse
import json
import math
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import nullcontext, redirect_stdout
from pathlib import Path
from shlex import quote
from time import perf_counter
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

import msmpetsc
from msmpetsc.errors import InputError, printable
from msmpetsc.results.disk import write_whole
from msmpetsc.scene.reading import load_scene
from msmpetsc.study.cases import launcher
from msmpetsc.study.forkserver import COLD
from msmpetsc.study.process import Processes

# default number of steps [-]; so that a check takes little time
STEPS = 20
# relative error of each step [-]; so that solver and ranks make no difference
ERROR = 1e-9
# allowed growth of an error by contact and buckling [-]
GROWTH = 10
ENERGIES = ("kinetic", "elastic", "potential", "contact")
# number of nodes whose positions are stored, evenly spaced in the numbering [-]
NODES = 5
HEAD = (
    f"{'scene':20} {'cells':>6} {'nodes':>6} {'springs':>8} "
    f"{'off by':>9} {'allowed':>9} {'time':>7}"
)
Unit = Literal["m", "J", "kg m/s"]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Size = Annotated[float, Field(ge=0, allow_inf_nan=False)]
# largest number of steps [-]; more steps would allow any difference
MOST_STEPS = int((2 / (GROWTH * ERROR)) ** 0.5)


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, populate_by_name=True)


class Recipe(_Strict):
    """The options of the run that gives the numbers of a scene.

    cells   : cages.count; None for the scene's own
    error   : relative error of each step
    steps   : number of steps from the start
    changes : changes of the scene as values of ``--set``
    """

    cells: Annotated[int, Field(ge=1)] | None = Field(
        validation_alias="cells asked for", serialization_alias="cells asked for"
    )
    error: float = ERROR
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


def run(args: argparse.Namespace) -> int:
    """Run each scene, and compare or store its numbers; return the exit status."""
    recipe = None
    if args.frames or args.cells or args.set:
        steps = min(args.frames or STEPS, MOST_STEPS)
        recipe = Recipe(cells=args.cells, steps=steps, changes=args.set)
    files = {scene: scene.with_suffix(".baseline.json") for scene in args.scenes}
    if not args.update:
        if recipe:
            raise InputError(
                "--cells, --frames and --set are for --update: a check uses the stored options"
            )
        return int(any(check(files, args.ranks, args.json).values()))
    if args.json:
        raise InputError("--json is for checks: --update compares nothing")
    for scene, file in files.items():
        update(scene, file, recipe, args.ranks)
    return 0


def update(scene: Path, file: Path, given: Recipe | None, ranks: int) -> None:
    """Run a scene and store its numbers.

    given : options of the run; None for the options stored before, or else the defaults
    """
    recipe = given or Recipe(cells=None, steps=STEPS)
    if file.is_file() and not given:
        recipe = read(file).run
    time = load_scene(scene, recipe.changes, by_user=False).time
    if time.error is not None:
        raise InputError(
            f"{scene}: time.error chooses steps by an estimate, so that no tolerance is known: "
            "--set time={step=..., duration=...} gives equal steps"
        )
    recipe = recipe.model_copy(update={"steps": min(recipe.steps, time.steps)})
    numbers = numbers_of(scene, recipe, ranks)
    write(file, numbers)
    count = len(numbers.counts) + len(numbers.numbers)
    accuracy = allowed(recipe.steps, "m")
    print(f"{file}: {count} numbers after {recipe.steps} steps, positions to {accuracy:.1g}")


def numbers_of(scene: Path, recipe: Recipe, ranks: int) -> Numbers:
    """Run a scene by a recipe and return its numbers. Raises InputError if the run fails."""
    cells = [] if recipe.cells is None else [f"cages.count={recipe.cells}"]
    words = [
        word
        for change in (*cells, "output.surface=false", *recipe.changes)
        for word in ("--set", change)
    ]
    with tempfile.TemporaryDirectory(prefix="msmpetsc-numbers-") as folder:
        path = Path(folder) / "run.h5"
        steps = ["--frames", str(recipe.steps), "--error", str(ERROR)]
        command = [*launcher(ranks), *COLD, "run", str(scene), "-o", str(path), *steps, *words]
        ended = Processes().run(command, path.with_suffix(".log"), math.inf)
        if ended.reason:
            raise InputError(f"{scene}: the run failed: {ended.reason}")
        return summary(path, recipe)


def check(files: Mapping[Path, Path], ranks: int, as_json: bool) -> dict[str, list[str]]:
    """Compare scenes with their stored numbers; print and return the differences by scene."""
    for scene, file in files.items():
        if not file.is_file():
            raise InputError(
                f"nothing is stored of {scene}: "
                f"msmpetsc check --update {quote(str(scene))} stores {file}"
            )
    stored = {scene: read(file) for scene, file in files.items()}
    # stored changes may only name files in or below the scene's folder
    for scene, numbers in stored.items():
        load_scene(scene, numbers.run.changes, by_user=False)
    with redirect_stdout(None) if as_json else nullcontext():
        print(HEAD, flush=True)
        by_scene = {str(scene): checked(scene, numbers, ranks) for scene, numbers in stored.items()}
        for scene_name, lines in by_scene.items():
            for line in lines:
                print(f"{scene_name}: {line}")
    if as_json:
        print(json.dumps({"same": not any(by_scene.values()), "differences": by_scene}, indent=1))
    return by_scene


def checked(scene: Path, stored: Numbers, ranks: int) -> list[str]:
    """Run a scene by its stored recipe, print a summary, and return a line for each difference."""
    began = perf_counter()
    # a run that fails must not keep the other scenes from their check
    try:
        numbers = numbers_of(scene, stored.run, ranks)
    except InputError as error:
        print(f"{scene.stem:20} FAILED", flush=True)
        return [str(error).removeprefix(f"{scene}: ")]
    lines = judged(numbers, stored)
    verdict = "DIFFERS" if lines else "same"
    _, difference, tolerance = max(
        differences(numbers, stored), key=lambda row: row[1] / row[2] if row[2] else np.inf
    )
    sizes = "{cells:6} {nodes:6} {springs:8}".format_map(numbers.counts)
    seconds = perf_counter() - began
    print(
        f"{scene.stem:20} {sizes} {difference:9.1e} {tolerance:9.1e} {seconds:5.1f} s {verdict}",
        flush=True,
    )
    return lines


# ---- stored numbers


def summary(path: Path, recipe: Recipe) -> Numbers:
    """Return the numbers to store of a result."""
    with msmpetsc.open(path) as result:
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


def differences(now: Numbers, stored: Numbers) -> Iterator[tuple[str, float, float]]:
    """Yield name, relative difference and allowed difference of each number."""
    for name in now.numbers.keys() | stored.numbers.keys():
        number = now.numbers.get(name)
        expected = stored.numbers.get(name)
        if (
            number is None
            or expected is None
            or number.unit != expected.unit
            or np.shape(number.value) != np.shape(expected.value)
        ):
            yield name, np.inf, 0.0
            continue
        difference = np.abs(np.subtract(number.value, expected.value, dtype=float)).max()
        # a damaged file may hold any scale
        scale = min(now.scales[number.unit], stored.scales[number.unit])
        relative = np.inf
        if difference == 0:
            relative = 0.0
        elif scale > 0 and np.isfinite(difference):
            relative = float(difference / scale)
        yield name, relative, allowed(stored.run.steps, number.unit)


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
