"""``msmpetsc check``: compare the numbers of a scene with those that ``--update`` stored.

Each step is solved to 1e-9, so that neither the number of ranks nor the way in which a step is
solved shows. Counts must be equal, the numbers of the last frame within the tolerance.

Tolerance. A step solved to the relative error e leaves e |x* - y| in x, |x* - y| being at most about the largest
displacement D. What goes on from there carries it along in y = 2 q_n - q_(n-1): after N steps it is e D N (N + 1) / 2.
Ten times as much is allowed, for contact and buckling make differences grow; twice that in energies and momentum, in
which errors of x count double. Positions are relative to D, energies to the largest of the run (the potential one
counted from the start), momentum to that of the whole mass at the largest kinetic energy.
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

STEPS = 20  # of a scene's numbers, if nothing else is asked for
ERROR = 1e-9  # of each step, relative
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
    """What is stored of a run: how it was made, counts, scales of errors, and numbers of the last frame."""

    run: Recipe
    counts: dict[str, Annotated[int, Field(ge=0)]]
    scales: dict[Unit, Size]
    numbers: dict[str, Number]


def run(args: argparse.Namespace) -> int:
    """Run each scene, and compare or store its numbers; return the exit status."""
    asked = None
    if args.frames or args.cells or args.set:
        asked = Recipe(
            cells=args.cells, steps=min(args.frames or STEPS, MOST_STEPS), changes=args.set
        )
    files = {scene: scene.with_suffix(".baseline.json") for scene in args.scenes}
    if not args.update:
        if asked:
            raise InputError(
                "--cells, --frames and --set are for --update: the numbers stored say how they were made"
            )
        return int(any(check(files, args.ranks, args.json).values()))
    if args.json:
        raise InputError("--update checks nothing: --json is of no use")
    for scene, file in files.items():
        update(scene, file, asked, args.ranks)
    return 0


def update(scene: Path, file: Path, asked: Recipe | None, ranks: int) -> None:
    """Run a scene and store its numbers, made as those before if nothing else is asked for."""
    recipe = asked or Recipe(cells=None, steps=STEPS)
    if file.is_file() and not asked:
        recipe = read(file).run
    time = load_scene(scene, recipe.changes, by_user=False).time
    if time.error is not None:
        raise InputError(
            f"{scene}: time.error chooses steps by an estimate: how far numbers may be apart then is not known; "
            "--set time={step=..., duration=...} takes steps of one length"
        )
    recipe = recipe.model_copy(update={"steps": min(recipe.steps, time.steps)})
    numbers = numbers_of(scene, recipe, ranks)
    write(file, numbers)
    count = len(numbers.counts) + len(numbers.numbers)
    accuracy = allowed(recipe.steps, "m")
    print(f"{file}: {count} numbers after {recipe.steps} steps, positions to {accuracy:.1g}")


def numbers_of(scene: Path, recipe: Recipe, ranks: int) -> Numbers:
    """Run a scene by a recipe; return its numbers. Raises InputError where the run fails."""
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
                f"nothing is stored of {scene}: msmpetsc check --update {quote(str(scene))} stores {file}"
            )
    stored = {scene: read(file) for scene, file in files.items()}
    for (
        scene,
        numbers,
    ) in stored.items():  # whose changes come with the scene, and name what lies beside it
        load_scene(scene, numbers.run.changes, by_user=False)
    with redirect_stdout(None) if as_json else nullcontext():
        print(HEAD, flush=True)
        wrong = {str(scene): checked(scene, numbers, ranks) for scene, numbers in stored.items()}
        print(
            "".join(f"{scene}: {line}\n" for scene, lines in wrong.items() for line in lines),
            end="",
        )
    if as_json:
        print(json.dumps({"same": not any(wrong.values()), "differences": wrong}, indent=1))
    return wrong


def checked(scene: Path, stored: Numbers, ranks: int) -> list[str]:
    """Run a scene as its stored numbers were made; print a summary and return the differences, a line each."""
    began = perf_counter()
    try:
        numbers = numbers_of(scene, stored.run, ranks)
    except InputError as error:  # other scenes are checked all the same
        print(f"{scene.stem:20} FAILED", flush=True)
        return [str(error).removeprefix(f"{scene}: ")]
    wrong = judged(numbers, stored)
    verdict = "DIFFERS" if wrong else "same"
    _, off, most = max(
        differences(numbers, stored), key=lambda row: row[1] / row[2] if row[2] else np.inf
    )
    sizes = "{cells:6} {nodes:6} {springs:8}".format_map(numbers.counts)
    print(
        f"{scene.stem:20} {sizes} {off:9.1e} {most:9.1e} {perf_counter() - began:5.1f} s {verdict}",
        flush=True,
    )
    return wrong


# ---- what is stored of a run


def summary(path: Path, recipe: Recipe) -> Numbers:
    """Return the numbers of a result that are stored."""
    with msmpetsc.open(path) as result:
        lattice, frames = result.lattice, result.frames
        rest, mass = lattice.nodes[:], lattice.mass[:]
        moved = max(np.linalg.norm(q - rest, axis=1).max() for q in frames.position)
        energies, q = {name: frames[name][:] for name in ENERGIES}, frames.position[-1]
        counts = {name: len(lattice[name]) for name in ("cells", "nodes", "springs", "pinned")}
        counts["frames"] = len(frames.time)
        momentum = frames.momentum[-1]
    some = np.linspace(0, len(q) - 1, NODES).astype(int)
    ends: dict[str, tuple[Unit, Any]] = {
        name: ("J", values[-1]) for name, values in energies.items()
    }
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
    """Return the allowed relative difference after so many steps."""
    return GROWTH * ERROR * steps * (steps + 1) / 2 * (1 if unit == "m" else 2)


def differences(now: Numbers, stored: Numbers) -> Iterator[tuple[str, float, float]]:
    """Yield the name, the relative difference and the allowed one of each number."""
    for name in now.numbers.keys() | stored.numbers.keys():
        one, other = now.numbers.get(name), stored.numbers.get(name)
        if (
            one is None
            or other is None
            or one.unit != other.unit
            or np.shape(one.value) != np.shape(other.value)
        ):
            yield name, np.inf, 0.0
            continue
        apart = np.abs(np.subtract(one.value, other.value, dtype=float)).max()
        scale = min(now.scales[one.unit], stored.scales[one.unit])  # of a damaged file any
        relative = np.inf
        if apart == 0:
            relative = 0.0
        elif scale > 0 and np.isfinite(apart):
            relative = float(apart / scale)
        yield name, relative, allowed(stored.run.steps, one.unit)


def judged(now: Numbers, stored: Numbers) -> list[str]:
    """Return a line for each count and number that differs from the stored one."""
    lines = [
        f"{name}: {now.counts.get(name)}, stored {stored.counts.get(name)}"
        for name in now.counts.keys() | stored.counts.keys()
        if now.counts.get(name) != stored.counts.get(name)
    ]
    for name, off, most in differences(now, stored):
        if off > most:
            values = f"{now.numbers.get(name, 'not there')}, stored {stored.numbers.get(name, 'not there')}"
            lines.append(f"{name}: {values}: {off:.2g} off, {most:.2g} allowed")
    return sorted(lines)


def write(path: Path, numbers: Numbers) -> None:
    """Store numbers. Raises InputError."""
    write_whole(path, json.dumps(numbers.model_dump(by_alias=True), indent=1) + "\n")


def read(path: Path) -> Numbers:
    """Return stored numbers. Raises InputError for a damaged file."""
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
