#!/usr/bin/env python3
"""Compare runs of scenes with published values: a table and a chart.

    scripts/yardstick.py [--fast] [WORD ...] | tee scripts/results/yardstick.md

The cases are in scenes/studies/yardstick/cases.toml, each with a scene beside it. A WORD selects
the cases whose names contain it. --fast runs only the coarse sizes of each case, which the tests
run too. Seconds are processor time of the steps of a run, without its set-up.
"""

import math
import sys
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from time import process_time
from typing import Any

import lab

import numpy as np
from mpi4py import MPI

import msmpetsc
from msmpetsc.app.mode_shapes import find_modes
from msmpetsc.app.request import RunRequest
from msmpetsc.build import build_model
from msmpetsc.fields import FRAME_FIELDS
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.scene.reading import Scene

FOLDER = lab.SCENES / "studies" / "yardstick"
# |error| shown as "exact", that of the solver in most cases [-]; least |error| drawn
EXACT, DRAWN = 1e-6, 3e-5
# cells that give the stress at a place: their distance less the degree [cells], their
# fill over the largest [-]; least singular value of the fit [-]
NEAR, WHOLE, FIT = 2.0, 0.99, 1e-9
INTRODUCTION = """
Values, errors and costs stand from coarse to fine. An error is relative, *exact* below 1e-6. The
order is observed: by the differences of three sizes in a geometric row, or else by the errors of
two. Seconds are processor time of the steps on one core, without set-up, or of the search for
modes. Products are with the Hessian. *Plane quadratic elements of ours* are a program apart, with
meshes that follow the surface.

![Errors over seconds and over cells](../../scenes/studies/yardstick/yardstick.png)

On the right, ours levels off at the difference of laws in Cook's membrane, 1.57%, and in CSM1 and
CSM2, 0.37%."""


LEFT_OUT = """
## Left out

- The *tuning fork* of CoFEA: its geometry has the BSD licence with four clauses, of which the third
  would ask for an acknowledgement in our advertising.
- *Shallow ironing*: eight codes say 0.30 to 0.53 for the friction over the press, which is a spread
  and no reference.
- CoFEA's values of LE1, LE10 and Cook's membrane, as peers: they have no numbers of cells."""


@dataclass(frozen=True)
class Value:
    """A quantity of a case.

    ours      : Python expression of the names that ``names_of`` returns
    reference : number, or Python expression of the case's constants
    within    : largest |error|, a number or a Python expression of n; "" for the case's own
    note      : cause of a deviation over 2% at the finest size
    """

    name: str
    ours: str
    reference: float | str
    within: float | str = ""
    note: str = ""


@dataclass(frozen=True)
class Peer:
    """Another program's published values of a case's first quantity, by numbers of cells."""

    name: str
    source: str
    cells: Sequence[float]
    values: Sequence[float]


@dataclass(frozen=True)
class Case:
    """A published problem.

    scene   : name of the scene beside the table
    setup   : the problem in a line; source: where a reader finds the reference
    theory  : reason for the bounds ``within``
    within  : largest |error| [-] of the finest fast size, a Python expression of n; tests assert it
    sizes   : numbers n of cells across, or of steps; ``fast``: number of sizes that --fast runs
    keys    : changes of the scene; a text is a Python expression of n
    let     : constants, numbers or Python expressions, for ``reference`` and ``ours``
    own     : the reference is from our own finite elements, not published
    modes   : number of modes of a scene that is not stepped
    """

    name: str
    scene: str
    setup: str
    source: str
    theory: str
    sizes: Sequence[float]
    keys: dict[str, Any]
    value: Sequence[Value]
    within: float | str = ""
    fast: int = 1
    let: dict[str, float | str] = field(default_factory=dict)
    modes: int = 0
    own: bool = False
    peer: Sequence[Peer] = ()

    @property
    def constants(self) -> dict[str, Any]:
        """Constants by name."""
        names: dict[str, Any] = dict(vars(math))
        for name, text in self.let.items():
            names[name] = evaluated(text, names)
        return names

    def reference(self, value: Value) -> float:
        """Return the reference of a value."""
        return float(evaluated(value.reference, self.constants))

    def bound(self, value: Value) -> float:
        """Return the largest |error| of a value at the finest fast size."""
        names = self.constants | {"n": self.sizes[self.fast - 1]}
        return float(evaluated(value.within or self.within, names))

    def error(self, value: Value, ours: float) -> float:
        """Return the relative error of a value."""
        return (ours - self.reference(value)) / abs(self.reference(value))


@dataclass(frozen=True)
class Run:
    """A run of a case: its size, costs, and a number for each value."""

    size: float
    cells: int
    seconds: float
    products: int
    ours: Sequence[float]


def cases() -> list[Case]:
    """Return all cases."""
    tables = tomllib.loads((FOLDER / "cases.toml").read_text())["case"]
    return [
        Case(
            **table
            | {"value": [Value(**row) for row in table["value"]]}
            | {"peer": [Peer(**row) for row in table.get("peer", ())]}
        )
        for table in tables
    ]


def evaluated(text: float | str | Sequence[Any], names: dict[str, Any]) -> Any:
    """Return the value of a Python expression; return anything but a text as it is."""
    # the table is a file of this tree, as this script is
    return eval(text, dict(names)) if isinstance(text, str) else text


# ---- runs


def measured(case: Case, size: float) -> Run:
    """Run a case at a size."""
    keys = {key: evaluated(text, case.constants | {"n": size}) for key, text in case.keys.items()}
    print(case.name, keys, file=sys.stderr, flush=True)
    file = FOLDER / f"{case.scene}.toml"
    scene = Scene.load(file, keys)
    names = case.constants
    if case.modes:
        begin = process_time()
        modes = find_modes(MPI.COMM_SELF, RunRequest(file, set=keys), case.modes)
        seconds, products = process_time() - begin, 0
        lattice = build_model(MPI.COMM_SELF, scene).lattice
        names |= {"frequencies": modes.frequencies, "np": np}
    else:
        simulation = msmpetsc.Simulation(scene)
        frames, times = [], []
        for frame in simulation.frames():
            frames.append(frame)
            times.append(process_time())
        assert simulation.model is not None
        lattice = simulation.model.lattice
        # the first frame is the start
        seconds = times[-1] - times[0]
        products = sum(frame.products for frame in frames)
        names |= vars(lattice) | names_of(scene, frames, lattice)
    ours = [float(evaluated(value.ours, names)) for value in case.value]
    return Run(size, len(lattice.cells), seconds, products, ours)


def names_of(scene: Scene, frames: list[msmpetsc.Frame], lattice: Lattice) -> dict[str, Any]:
    """Return names for expressions: fields of all frames (T, ...), and functions.

    at(probe)     : its positions (T, 3) [m]
    moved(probe)  : its displacements (T, 3) [m] from the start
    peaks(y)      : times and heights (k, 2) of the local maxima of y (T,)
    stress_at(*x) : stress (6,) [Pa] of the last frame at a place at rest, by a polynomial fit
    """
    fields = {
        name: np.array([getattr(frame, name) for frame in frames])
        for name in FRAME_FIELDS
        if getattr(frames[-1], name) is not None
    }
    probes = [probe.name for probe in scene.output.probe]

    def at(name: str) -> np.ndarray:
        return fields["probe"][:, probes.index(name)]

    def moved(name: str) -> np.ndarray:
        return at(name) - at(name)[0]

    def peaks(y: np.ndarray) -> np.ndarray:
        return np.array([*maxima(fields["time"], y)]).reshape(-1, 2)

    def stress_at(*place: float, degree: int = 1) -> np.ndarray:
        # a polynomial through the stresses of whole cells near the place
        x = (lattice.nodes[lattice.cells].mean(axis=1) - place) / lattice.cell_size
        near = np.linalg.norm(x, axis=1) < NEAR + degree
        near &= lattice.cell_fill > WHOLE * lattice.cell_fill.max()
        # along an axis with a single layer of cells the stress is constant
        x[:, np.ptp(x[near], axis=0) < FIT] = 0
        ones = np.column_stack([np.ones(len(x)), x])[near]
        terms = [ones[:, i] * ones[:, j] for i in range(4) for j in range(i, 4)]
        basis = ones if degree == 1 else np.column_stack(terms)
        return np.linalg.lstsq(basis, fields["cell_stress"][-1][near], rcond=FIT)[0][0]

    functions = {"at": at, "moved": moved, "peaks": peaks, "stress_at": stress_at}
    return fields | functions | {"np": np, "norm": np.linalg.norm}


def maxima(t: np.ndarray, y: np.ndarray) -> Iterator[tuple[float, float]]:
    """Yield times and heights of local maxima, the vertices of parabolas."""
    for k in 1 + np.flatnonzero((y[1:-1] > y[:-2]) & (y[1:-1] >= y[2:])):
        a, b, c = np.polyfit(t[k - 1 : k + 2] - t[k], y[k - 1 : k + 2], 2)
        yield t[k] - b / (2 * a), c - b**2 / (4 * a)


def order(case: Case, value: Value, runs: Sequence[Run]) -> float | None:
    """Return the observed order of convergence, None if there is none.

    Three sizes in a geometric sequence give it by their differences, else two sizes by their
    errors.
    """
    if len(runs) < 2:
        return None
    k = case.value.index(value)
    numbers = [run.ours[k] for run in runs[-3:]]
    ratios = {round(b.size / a.size, 9) for a, b in pairwise(runs[-3:])}
    if len(numbers) == 3 and len(ratios) == 1:
        coarse, fine = (b - a for a, b in pairwise(numbers))
    else:
        coarse, fine = (case.error(value, x) for x in numbers[-2:])
    if coarse * fine <= 0 or abs(fine) >= abs(coarse) or abs(fine) < EXACT * abs(numbers[-1]):
        return None
    return math.log(coarse / fine) / math.log(runs[-1].size / runs[-2].size)


# ---- table, notes, chart


def shown(numbers: Sequence[float], digits: int = 4) -> str:
    """Return numbers from coarse to fine in a cell of the table."""
    return " · ".join(f"{x:,}" if isinstance(x, int) else f"{x:.{digits}g}" for x in numbers)


def error_shown(error: float) -> str:
    """Return an error in percent."""
    return "exact" if abs(error) < EXACT else f"{100 * error:+.2g}%"


def rows(number: int, case: Case, runs: Sequence[Run]) -> lab.Rows:
    """Yield a row for each value of a case."""
    for k, value in enumerate(case.value):
        errors = [case.error(value, run.ours[k]) for run in runs]
        p = order(case, value, runs)
        yield {
            "": f"{number}",
            "case": "" if k else case.name,
            "quantity": value.name,
            "reference": f"{case.reference(value):.5g}",
            "ours": shown([run.ours[k] for run in runs]),
            "error": " · ".join(map(error_shown, errors)),
            "order": "" if p is None else f"{p:.1f}",
            "cells": "" if k else shown([run.cells for run in runs]),
            "seconds": "" if k else shown([run.seconds for run in runs], 2),
            "products": "" if k else shown([run.products for run in runs]),
        }


def notes(number: int, case: Case) -> Iterator[str]:
    """Yield the set-up of a case, its source and the causes of deviations."""
    scene = f"../../scenes/studies/yardstick/{case.scene}.toml"
    yield f"{number}. **{case.name}** ([scene]({scene})). {case.setup} *Reference:* {case.source}"
    bounds = sorted({case.bound(value) for value in case.value})
    within = " and ".join(f"{100 * bound:.2g}%" for bound in bounds)
    yield f"    *Bound at {case.sizes[case.fast - 1]}:* {within}. {case.theory}"
    for peer in case.peer:
        yield f"    *{peer.name}:* {peer.source}"
    for value in case.value:
        if value.note:
            yield f"    *Deviation of {value.name}:* {value.note}"


def chart(results: dict[str, tuple[Case, list[Run]]], path: Path) -> None:
    """Draw errors over seconds, and over cells beside the peers' published values.

    Errors below DRAWN are drawn at DRAWN.
    """
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, (time, size) = pyplot.subplots(1, 2, figsize=(15, 9), layout="constrained")
    colours = pyplot.get_cmap("tab20")(range(20))
    ends: list[tuple[float, float, str, Any]] = []
    for number, (case, runs) in enumerate(results.values(), 1):
        values = [zip(case.value, run.ours, strict=True) for run in runs]
        errors = [max(DRAWN, *(abs(case.error(*pair)) for pair in pairs)) for pairs in values]
        style: dict[str, Any] = {"color": colours[number % 20], "marker": "o", "ms": 4}
        seconds = [max(run.seconds, 1e-3) for run in runs]
        time.loglog(seconds, errors, **style | {"lw": 1, "ms": 2})
        ends.append((errors[-1], seconds[-1], f"{number} {case.name}", style["color"]))
        if not case.peer:
            continue
        ours = [abs(case.error(case.value[0], run.ours[0])) for run in runs]
        size.loglog([run.cells for run in runs], ours, **style, label=f"{case.name}: ours")
        for mark, peer in zip("sv^D*Pxd", case.peer, strict=False):
            theirs = [max(abs(case.error(case.value[0], x)), DRAWN) for x in peer.values]
            style = {"color": colours[number % 20], "marker": mark, "ms": 4, "ls": ":"}
            size.loglog(peer.cells, theirs, **style, label=f"{case.name}: {peer.name}")
    # names are in a column of their own, at the height of the ends of their lines
    for place, (error, last, name, colour) in enumerate(sorted(ends, key=lambda end: end[0])):
        leader = {"arrowstyle": "-", "color": colour, "lw": 0.5, "alpha": 0.5, "relpos": (0, 0.5)}
        time.annotate(
            name, (last, error), (1.04, (place + 0.5) / len(ends)), "data", "axes fraction",
            leader, fontsize=8, va="center",
        )  # fmt: skip
    time.set(xlabel="seconds of processor time", ylabel="largest relative error of a case")
    size.set(xlabel="cells", ylabel="relative error of a case's first quantity")
    if size.has_data():
        size.legend(fontsize=8)
    figure.savefig(path, dpi=80)


def main() -> None:
    """Print the table and draw the chart."""
    parser = lab.parser(__doc__)
    parser.add_argument("words", nargs="*", metavar="WORD", help="run cases whose names contain it")
    parser.add_argument("--fast", action="store_true", help="run the coarse sizes only")
    parser.add_argument("--chart", type=Path, default=FOLDER / "yardstick.png", help="a PNG file")
    args = parser.parse_args()
    lab.heading()
    results: dict[str, tuple[Case, list[Run]]] = {}

    def all_rows(chosen: Sequence[Case]) -> lab.Rows:
        for case in chosen:
            sizes = case.sizes[: case.fast] if args.fast else case.sizes
            runs = [measured(case, size) for size in sizes]
            results[case.name] = case, runs
            yield from rows(len(results), case, runs)

    print(INTRODUCTION)
    everything = [
        case for case in cases() if not args.words or any(word in case.name for word in args.words)
    ]
    titles = {False: "Against published values", True: "Against our own finite elements"}
    for own, title in titles.items():
        if chosen := [case for case in everything if case.own is own]:
            print(f"\n## {title}")
            lab.table(all_rows(chosen))
    print("\n## Set-ups, sources, deviations\n")
    for number, (case, _) in enumerate(results.values(), 1):
        print("\n".join(notes(number, case)))
    print(LEFT_OUT)
    chart(results, args.chart)


if __name__ == "__main__":
    main()
