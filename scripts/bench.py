#!/usr/bin/env python3
"""The cost of a step, today's `newton` beside what it took the place of: prints Markdown, leaves out/bench/bench.csv
and bench.png. Needs the meshes.

    scripts/bench.py [--only NAME ...] [--frames N] [--repeats N] [--large] [--out FOLDER]

Runs the paper's scenes, clamped beams of 9,000 and 96,000 cells and, with --large, of 995,000, each to a step error of
1e-3 on one core: `newton-jacobi`, `newton -pc_type gamg` and `newton`, one after the other, and all of that again for
each repeat; the beam of 96,000 cells by `newton` on two ranks, too. --only takes rows whose name contains NAME.

Each run is a `msmpetsc run` of its own. Only frames in which the body moves count: those that every run of a row had
to solve, the first left out, for what is done once shows in it. A time is the median of these frames, then of the
repeats, with the least and the greatest of the repeats in brackets. Iterations and products with the Hessian, which do
not depend on the machine, are means of the same frames. Where a cell has three figures, they are of the three methods.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from clone import ROOT, parser

import numpy as np
from table1 import PAPER

from msmpetsc.output.reader import Result

ERROR = "1e-3"
METHODS = {
    "newton-jacobi": ["--preset", "newton-jacobi"],
    "newton, gamg": ["--preset", "newton", "-pc_type", "gamg"],
    "newton": ["--preset", "newton"],
}
TODAY = "newton"
SMALL = 50_000  # nodes: of fewer the memory is mostly Python's
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1"}
WANTED = {  # times as fast as the better of the other two
    "armadillo_leg": 8.0, "armadillo_palm": 8.0, "armadillo_forehead": 8.0, "dragon_raise_push": 8.0,
    "lung_press": 6.0, "heart_pull": 3.0, "bunny_fall": 1.0, "brain_fall": 1.0,
    "beam 1e4": 3.0, "beam 1e4 stiff": 3.0, "beam 1e5": 3.0, "beam 1e6": 4.0,
}  # fmt: skip
RANKS, WANTED_OF_RANKS = 2, 1.8
BEAMS = {  # cells along the beam, Young's modulus [Pa], frames
    "beam 1e4": (40, 5e5, 30),
    "beam 1e4 stiff": (40, 5e7, 30),
    "beam 1e5": (88, 5e5, 10),
    "beam 1e6": (192, 5e5, 4),
}
LARGE, ON_RANKS = "beam 1e6", "beam 1e5"
SIDES = 1.0, 0.375, 0.375  # of a beam [m]
QUADS = (0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)  # seen from outside
BEAM = """
[mesh]
source = "beam.obj"
[cages]
cell_size = {size!r}
[material]
young_modulus = {young!r}
density = 1000
[time]
step = 0.016666666666666666
duration = {duration!r}
[gravity]
acceleration = [0, 0, -9.81]
[[pin]]
region = {{ half_space = {{ point = [0.001, 0, 0], normal = [-1, 0, 0] }} }}
[output]
surface = false
"""


@dataclass(frozen=True)
class Case:
    """A row of the table: a scene's file, and the frames of it that are run; None for all."""

    name: str
    scene: Path
    frames: int | None

    @property
    def paper(self) -> tuple[float, float] | None:
        """The paper's frames a second on a CPU and on a GPU."""
        name = self.name.split("_")[0]
        return PAPER[name][4:] if name in PAPER else None


@dataclass(frozen=True)
class Run:
    """What one run was: its numbers frame by frame, frame 0 left out, and what --measure tells of it."""

    frames: dict[str, np.ndarray]
    cost: dict[str, Any]

    @property
    def is_solved(self) -> np.ndarray:
        """(frames,) bool: in which of them the first guess would not do."""
        return self.frames["iterations"] > 0


# ---- cases and runs


def beam(name: str, folder: Path) -> Path:
    """The scene of a beam, written there."""
    along, young, frames = BEAMS[name]
    corners = [[SIDES[c] * (i >> c & 1) for c in range(3)] for i in range(8)]
    lines = ["v {} {} {}".format(*corner) for corner in corners]
    lines += ["f {} {} {}".format(*(1 + quad[i] for i in three)) for quad in QUADS for three in ((0, 1, 2), (0, 2, 3))]
    (folder / "beam.obj").write_text("\n".join(lines) + "\n")
    path = folder / f"{name.replace(' ', '_')}.toml"
    path.write_text(BEAM.format(size=SIDES[0] / along, young=young, duration=frames / 60))
    return path


def cases(args: argparse.Namespace) -> Iterator[Case]:
    """The rows that are asked for."""
    for name in WANTED:
        asked = any(word in name for word in args.only) if args.only else name != LARGE or args.large
        if asked:
            scene = beam(name, args.out) if name in BEAMS else ROOT / "scenes" / f"{name}.toml"
            yield Case(name, scene, args.frames)


def run(case: Case, words: Sequence[str], folder: Path, ranks: int = 1) -> Run | None:
    """One run; None if it failed, which is said."""
    result, measure = folder / "run.h5", folder / "run.json"
    launcher = ["mpiexec", "-n", str(ranks)] if ranks > 1 else []
    command = [*launcher, sys.executable, "-m", "msmpetsc", "run", str(case.scene), "-o", str(result), "--overwrite"]
    command += ["--error", ERROR, "--set", "output.surface=false", "--measure", str(measure), *words]
    command += ["--frames", str(case.frames)] if case.frames else []
    print(case.name, *words, f"on {ranks} ranks" * (ranks > 1), file=sys.stderr, flush=True)
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=ENVIRONMENT)
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if "error" in line.lower()]
        print("  failed:", said[0] if said else f"status {done.returncode}", file=sys.stderr)
        return None
    names = "wall_time", "iterations", "ksp_its", "products", "step_error"
    with Result(result) as read:
        return Run({name: read.frames[name][1:] for name in names}, json.loads(measure.read_text()))


def alternated(case: Case, repeats: int, folder: Path) -> dict[str, list[Run]]:
    """The repeats of each method, no two of one method after each other; of one that failed none."""
    runs: dict[str, list[Run]] = {name: [] for name in METHODS}
    failed = set()
    for _ in range(repeats):
        for name, words in METHODS.items():
            one = None if name in failed else run(case, words, folder)
            if one:
                runs[name].append(one)
            else:
                failed.add(name)
    return {name: some for name, some in runs.items() if name not in failed}


# ---- figures


def moving(runs: Sequence[Run]) -> np.ndarray:
    """(frames,) bool: those that count; where there are none of that kind the first, or all."""
    solved = np.all([one.is_solved for one in runs], axis=0)
    later = solved & (np.arange(len(solved)) > 0)
    return next((some for some in (later, solved) if some.any()), np.ones(len(solved), bool))


def figures(runs: Sequence[Run], counted: np.ndarray) -> dict[str, float]:
    """The columns of one method, of the frames that count; counts do not differ between repeats."""
    times = [1e3 * float(np.median(one.frames["wall_time"][counted])) for one in runs]
    frames, cost = {name: values[counted] for name, values in runs[0].frames.items()}, runs[0].cost
    seconds = median(float(one.frames["wall_time"][counted].mean()) for one in runs)
    iterations, its = float(frames["iterations"].sum()), float(frames["ksp_its"].sum())
    return {
        "ms": median(times), "ms least": min(times), "ms greatest": max(times),
        "frames a second": 1 / seconds,
        "us a cell": 1e3 * median(times) / cost["cells"],
        "iterations": iterations / len(frames["iterations"]),
        "KSP its": float(frames["ksp_its"].mean()),
        "its an iteration": its / max(iterations, 1.0),
        "products": float(frames["products"].mean()),
        "error": float(frames["step_error"].max()),
        "set-up s": median(one.cost["time"]["setup"] for one in runs),
        "kB a node": min(one.cost["memory"] for one in runs) / cost["nodes"] / 1e3,
        "hierarchy kB a node": cost["hierarchy"]["bytes"] / cost["nodes"] / 1e3,
        "builds": cost["hierarchy"]["builds"],
    }  # fmt: skip


def row(case: Case, runs: dict[str, list[Run]]) -> dict[str, Any]:
    """A row of the CSV: the columns of each method, and how they compare."""
    counted = moving([one for some in runs.values() for one in some])
    cost = next(iter(runs.values()))[0].cost
    table = {"row": case.name, "cells": cost["cells"], "nodes": cost["nodes"], "frames that count": int(counted.sum())}
    found = {name: figures(some, counted) for name, some in runs.items()}
    table |= {f"{name}: {column}": value for name, columns in found.items() for column, value in columns.items()}
    others = [found[name]["ms"] for name in found if name != TODAY]
    if TODAY in found and others:
        table |= {"times as fast": min(others) / found[TODAY]["ms"], "wanted": WANTED[case.name]}
    if case.paper:
        table |= {"paper, CPU": case.paper[0], "paper, GPU": case.paper[1]}
    return table


def ranks_row(case: Case, alone: list[Run], repeats: int, folder: Path) -> dict[str, Any] | None:
    """Today's method on two ranks beside one."""
    words = METHODS[TODAY]
    one: list[Run] = []
    two: list[Run] = []
    for _ in range(repeats):
        for ranks, runs in ((1, one), (RANKS, two)):
            done = run(case, words, folder, ranks)
            if done is None:
                return None
            runs.append(done)
    counted = moving([*alone, *one, *two])
    of_one, of_two = figures(one, counted), figures(two, counted)
    table = {"row": f"{case.name}, {RANKS} ranks", "cells": one[0].cost["cells"], "nodes": one[0].cost["nodes"]}
    table |= {"frames that count": int(counted.sum()), "1 rank: ms": of_one["ms"]}
    table |= {f"{TODAY}: {column}": value for column, value in of_two.items()}
    return table | {"times as fast": of_one["ms"] / of_two["ms"], "wanted": WANTED_OF_RANKS}


# ---- what is left


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """All figures, a row each."""
    columns = list(dict.fromkeys(name for one in rows for name in one))
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def each(one: dict[str, Any], column: str) -> str:
    """A figure of all methods, 120 / 40 / 12."""
    return " / ".join(shown(one.get(f"{name}: {column}")) for name in METHODS)


def shown(value: float | None) -> str:
    """A number of three digits; a dash for none."""
    if value is None:
        return "-"
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def spread(one: dict[str, Any], name: str) -> str:
    """A time and, where it was taken more than once, the least and the greatest of it."""
    time, least, greatest = (one.get(f"{name}: ms{end}") for end in ("", " least", " greatest"))
    return shown(time) if least == greatest else f"{shown(time)} ({shown(least)} to {shown(greatest)})"


def cells_of(one: dict[str, Any]) -> dict[str, str]:
    """A row of the Markdown table."""
    rate, gpu = one.get(f"{TODAY}: frames a second"), one.get("paper, GPU")
    return {
        "": one["row"],
        "cells": f"{one['cells']:,}",
        **{f"{name} [ms a frame]": spread(one, name) for name in METHODS},
        "times as fast (wanted)": f"{shown(one.get('times as fast'))} ({shown(one.get('wanted'))})",
        "KSP its": each(one, "KSP its"),
        "products": each(one, "products"),
        "its an iteration": each(one, "its an iteration"),
        "error": shown(one.get(f"{TODAY}: error")),
        "us a cell": shown(one.get(f"{TODAY}: us a cell")),
        "frames/s": shown(rate),
        "paper CPU, GPU": f"{shown(one.get('paper, CPU'))}, {shown(gpu)}" if gpu else "-",
        "of the GPU's": f"{rate / gpu:.2f}" if rate and gpu else "-",
        "set-up [s]": shown(one.get(f"{TODAY}: set-up s")),
        "kB a node": shown(one.get(f"{TODAY}: kB a node") if one["nodes"] > SMALL else None),
    }


def print_markdown(rows: Sequence[dict[str, Any]]) -> None:
    """The table, a row for each that was run."""
    table = [cells_of(one) for one in rows]
    for line in (list(table[0]), ["---"] * len(table[0]), *(list(cells.values()) for cells in table)):
        print("|", " | ".join(line), "|")


def draw(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Points at the time a frame, old and new, with the paper's rates; the label says how many times as fast."""
    import matplotlib.ticker
    from matplotlib.figure import Figure

    from msmpetsc.study.charts.plot import COLORS, FAINT, GRID

    with matplotlib.rc_context({"axes.grid": True, "axes.axisbelow": True, "grid.color": GRID, "savefig.dpi": 150}):
        figure = Figure(figsize=(10, 1.9 + 0.5 * len(rows)), layout="constrained")
        axes = figure.subplots()
        for kind, color in (("CPU", FAINT), ("GPU", "black")):
            draw_paper(axes, rows, kind, color)
        for name, color, marker in zip(METHODS, (COLORS[1], COLORS[5], COLORS[0]), "sDo", strict=True):
            draw_method(axes, rows, name, color, marker)
        for at, one in enumerate(rows):
            draw_ratio(axes, at, one)
        axes.set_yticks(range(len(rows)), [f"{one['row']}\n{one['cells']:,} cells" for one in rows])
        axes.set(xscale="log", xlabel=f"time a frame [ms], the median and the range of the repeats; step error {ERROR}")
        axes.xaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
        axes.xaxis.set_minor_locator(matplotlib.ticker.NullLocator())
        axes.invert_yaxis()
        figure.legend(loc="outside lower center", ncols=3, markerscale=0.6)
        figure.savefig(path)


def draw_method(axes: Any, rows: Sequence[dict[str, Any]], name: str, color: str, marker: str) -> None:
    """The points of one method."""
    known = {at: one for at, one in enumerate(rows) if one.get(f"{name}: ms")}
    columns = (f"{name}: ms{end}" for end in ("", " least", " greatest"))
    time, least, greatest = (np.array([one[column] for one in known.values()]) for column in columns)
    ends = [time - least, greatest - time]
    axes.errorbar(time, list(known), xerr=ends, fmt=marker, ms=8, color=color, capsize=3, label=name, zorder=3)


def draw_paper(axes: Any, rows: Sequence[dict[str, Any]], kind: str, color: str) -> None:
    """Marks at the paper's time a frame."""
    rates = {at: one[f"paper, {kind}"] for at, one in enumerate(rows) if one.get(f"paper, {kind}")}
    if rates:
        times, label = [1e3 / rate for rate in rates.values()], f"the paper's {kind}, its error unknown"
        axes.plot(times, list(rates), "|", ms=22, mew=2.5, color=color, label=label)


def draw_ratio(axes: Any, at: int, one: dict[str, Any]) -> None:
    """A line from the better of the old to the new, and its length in words."""
    if one.get("times as fast"):
        new, than = one[f"{TODAY}: ms"], " as on one" if "1 rank: ms" in one else ""
        axes.plot([new, new * one["times as fast"]], [at, at], color="#8a8f98", linewidth=1, zorder=1)
        words = f"{shown(one['times as fast'])} times as fast{than}"
        axes.annotate(words, (new, at), (0, 8), textcoords="offset points")


def rows_of(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The rows, as they are run."""
    for case in cases(args):
        runs = alternated(case, args.repeats, args.out)
        if not runs:
            continue
        yield row(case, runs)
        if case.name == ON_RANKS and TODAY in runs:
            on_ranks = ranks_row(case, runs[TODAY], args.repeats, args.out)
            if on_ranks:
                yield on_ranks


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--only", nargs="+", default=[], metavar="NAME", help="rows whose name contains one of these")
    options.add_argument("--frames", type=int, metavar="N", help="steps of each run; all of the scene's if absent")
    options.add_argument("--repeats", type=int, default=5, metavar="N", help="runs of each method (5)")
    options.add_argument("--large", action="store_true", help=f"{LARGE}, too, which takes hours")
    options.add_argument("--out", type=Path, default=ROOT / "out" / "bench", metavar="FOLDER", help="out/bench")
    args = options.parse_args()
    args.out = args.out.resolve()
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for one in rows_of(args):
        rows.append(one)
        write_csv(args.out / "bench.csv", rows)  # what was measured outlives a kill
    if rows:
        print_markdown(rows)
        draw(args.out / "bench.png", rows)


if __name__ == "__main__":
    main()
