"""What the studies of this folder share: runs of scenes in processes of their own, repeats, tables in Markdown."""

import atexit
import datetime
import json
import shlex
import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

from clone import ROOT

import numpy as np
import trimesh

from msmpetsc import __version__
from msmpetsc.backend.machine import machine
from msmpetsc.results.reader import Result
from msmpetsc.study.process import Ended, Processes

SCENES, OUT = ROOT / "scenes", ROOT / "out"
DAY = 86_400.0  # [s]
PROCESSES = Processes()  # of all that a script runs
atexit.register(PROCESSES.close)
T = TypeVar("T")
Row = Mapping[str, object]  # of a table: cells by column
Rows = Iterator[Row]


# ---- runs


@dataclass(frozen=True)
class Run:
    """A run that ended.

    failure : why it did not come to its end; empty if it did
    status  : its exit status; None where time ran out
    """

    path: Path
    failure: str = ""
    status: int | None = 0

    @cached_property
    def cost(self) -> dict[str, Any]:
        """What `run --measure` says of it."""
        return json.loads(self.path.with_suffix(".json").read_text())

    def frames(self, *names: str, start: int = 1) -> dict[str, np.ndarray]:
        """Return values of the frames from ``start`` on, (frames, ...) each."""
        with Result(self.path) as result:
            return {name: result.frames[name][start:] for name in names}


def run(
    scene: str | Path,
    path: Path,
    words: Iterable[object] = (),
    changes: Iterable[str] = (),
    ranks: int = 1,
    timeout: float = DAY,
    warm: bool = False,
) -> Run:
    """Run a scene, named or a file, in a process of its own, and say so; its log and its cost lie beside ``path``.

    words : options of `msmpetsc run`, and of PETSc; changes : those of --set
    warm  : spare it the start of the program, where no time is asked
    """
    file = file_of(scene)
    command: list[object] = ["-m", "msmpetsc", "run", file, "-o", path, "--overwrite", *words]
    command += [
        "--measure",
        path.with_suffix(".json"),
        *(word for change in changes for word in ("--set", change)),
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    print(file.stem, *words, *changes, f"({ranks} ranks)", file=sys.stderr, flush=True)
    ended = python(command, path.with_suffix(".log"), ranks, timeout, warm)
    if ended.reason:
        print("  failed:", ended.reason, file=sys.stderr)
    return Run(path, ended.reason, ended.status)


def file_of(scene: str | Path) -> Path:
    """Return the file of a scene of scenes/ by its name, or of a path."""
    return Path(scene) if Path(scene).suffix == ".toml" else SCENES / f"{scene}.toml"


def python(
    words: Iterable[object], log: Path, ranks: int = 1, timeout: float = DAY, warm: bool = False
) -> Ended:
    """Run Python with these words to its end, what it says into ``log``."""
    launcher = (
        ["mpiexec", "-n", str(ranks)] if ranks > 1 else []
    )  # study.cases' starts PETSc where it is imported
    return PROCESSES.run([*launcher, sys.executable, *map(str, words)], log, timeout, warm)


def box(path: Path, sides: Sequence[float] | np.ndarray) -> str:
    """Write a box with a corner at the origin; return the change that makes it the mesh of a scene."""
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(bounds=np.array([np.zeros(3), sides])).export(path)
    return f'mesh.source="{path}"'


# ---- repeats


def alternated(kinds: Mapping[str, Callable[[], T | None]], repeats: int) -> dict[str, list[T]]:
    """Do each kind so often, no one twice in a row while there are others; one that gives None is not done again."""
    found: dict[str, list[T]] = {name: [] for name in kinds}
    failed = set()
    for name in [*kinds] * repeats:
        value = None if name in failed else kinds[name]()
        if value is None:
            failed.add(name)
        else:
            found[name].append(value)
    return {name: [] if name in failed else values for name, values in found.items()}


def spread(values: Sequence[float]) -> str:
    """Return the median, and the least and the greatest where there are several."""
    ends = f" ({shown(min(values))} to {shown(max(values))})" if len(values) > 1 else ""
    return shown(median(values)) + ends


# ---- what is printed


def slope(sizes: Sequence[float] | np.ndarray, errors: Sequence[float] | np.ndarray) -> float:
    """Return the slope of a line fitted to log |error| over log size."""
    return np.polyfit(np.log(sizes), np.log(np.abs(errors)), 1)[0]


def shown(value: object) -> str:
    """Return a cell of a table: three digits of a float, commas in an int, nothing of None."""
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:,.0f}" if 100 <= abs(value) < 1e6 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def percent(share: float, digits: int = 1) -> str:
    """Return a signed share in percent."""
    return f"{100 * share:+.{digits}f}%"


def table(rows: Iterable[Row]) -> None:
    """Print rows as they come, under the columns of the first; one that has more columns begins a table of its own."""
    columns: list[str] = []
    for row in rows:
        if not set(row) <= set(columns):
            columns = list(row)
            print(f"\n| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
        print("|", " | ".join(shown(row.get(column)) for column in columns), "|", flush=True)


def parser(documentation: str | None) -> ArgumentParser:
    """Return a parser that prints a script's documentation for --help."""
    return ArgumentParser(description=documentation, formatter_class=RawDescriptionHelpFormatter)


def tables(documentation: str | None, tables: Mapping[str, Callable[[], Rows]]) -> None:
    """Print the tables of a study that the command line names, or all."""
    options = parser(documentation)
    options.add_argument(
        "tables", nargs="*", metavar="TABLE", help=f"of {', '.join(tables)}; all if none is named"
    )
    args = options.parse_args()
    if unknown := set(args.tables) - set(tables):
        options.error(f"no table {', '.join(sorted(unknown))}: {', '.join(tables)}")
    heading()
    for name in args.tables or tables:
        print(f"\n## {name}")
        table(tables[name]())


def heading() -> None:
    """Print the command of a script, the day and the machine, below which its tables stand."""
    name, *words = sys.argv
    print(
        f"# {Path(name).name}\n\n```sh\n{shlex.join([f'scripts/{Path(name).name}', *words])}\n```\n"
    )
    host = machine()
    print(
        f"{datetime.date.today()}, msmpetsc {__version__}, {host['cpu']}, {host['cores']} cores.",
        flush=True,
    )
