"""Common parts of the studies: runs of scenes in child processes, repeats, Markdown tables."""

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

SCENES = ROOT / "scenes"
OUT = ROOT / "out"
# [s]
DAY = 86_400.0
PROCESSES = Processes()
atexit.register(PROCESSES.close)
T = TypeVar("T")
# cells of a table's row, by column
Row = Mapping[str, object]
Rows = Iterator[Row]


# ---- runs


@dataclass(frozen=True)
class Run:
    """A run that ended.

    failure : why the run failed, "" if it did not
    status  : exit status; None after a timeout
    """

    path: Path
    failure: str = ""
    status: int | None = 0

    @cached_property
    def cost(self) -> dict[str, Any]:
        """Return the contents of the file that `run --measure` has written."""
        return json.loads(self.path.with_suffix(".json").read_text())

    def frames(self, *names: str, start: int = 1) -> dict[str, np.ndarray]:
        """Return columns of the frames from ``start`` on, each (frames, ...)."""
        with Result(self.path) as result:
            return {name: result.frames[name][start:] for name in names}


def run(
    scene: str | Path,
    path: Path,
    words: Iterable[object] = (),
    changes: Iterable[str] = (),
    ranks: int = 1,
    timeout: float = DAY,
) -> Run:
    """Run a scene in a child process and report it on standard error.

    scene   : name of a scene in scenes/, or a scene file
    path    : result file; log and measure file get the same name with another suffix
    words   : options of `msmpetsc run` and of PETSc
    changes : overrides for --set
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
    ended = python(command, path.with_suffix(".log"), ranks, timeout)
    if ended.reason:
        print("  failed:", ended.reason, file=sys.stderr)
    return Run(path, ended.reason, ended.status)


def file_of(scene: str | Path) -> Path:
    """Return the file of a scene, given its name in scenes/ or its path."""
    return Path(scene) if Path(scene).suffix == ".toml" else SCENES / f"{scene}.toml"


def python(words: Iterable[object], log: Path, ranks: int = 1, timeout: float = DAY) -> Ended:
    """Run Python with these arguments to its end; write all output to ``log``."""
    # study.cases has a launcher, but importing it starts PETSc
    launcher = ["mpiexec", "-n", str(ranks)] if ranks > 1 else []
    return PROCESSES.run([*launcher, sys.executable, *map(str, words)], log, timeout)


def box(path: Path, sides: Sequence[float] | np.ndarray) -> str:
    """Write a box with a corner at the origin; return the override that makes it a scene's mesh."""
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(bounds=np.array([np.zeros(3), sides])).export(path)
    return f'mesh.source="{path}"'


# ---- repeats


def alternated(kinds: Mapping[str, Callable[[], T | None]], repeats: int) -> dict[str, list[T]]:
    """Call each function ``repeats`` times in turn; return the values of each by its name.

    A function that has returned None is not called again, and its list is empty.
    """
    values: dict[str, list[T]] = {name: [] for name in kinds}
    failed = set()
    for name in [*kinds] * repeats:
        value = None if name in failed else kinds[name]()
        if value is None:
            failed.add(name)
        else:
            values[name].append(value)
    return {name: [] if name in failed else kept for name, kept in values.items()}


def spread(values: Sequence[float]) -> str:
    """Return the median, with the least and the greatest of several values in brackets."""
    ends = f" ({shown(min(values))} to {shown(max(values))})" if len(values) > 1 else ""
    return shown(median(values)) + ends


# ---- output


def shown(value: object) -> str:
    """Return a value as a table's cell: three digits of a float, "" for None."""
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:,.0f}" if 100 <= abs(value) < 1e6 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def percent(share: float, digits: int = 1) -> str:
    """Return a signed share in percent."""
    return f"{100 * share:+.{digits}f}%"


def table(rows: Iterable[Row]) -> None:
    """Print rows as they come, with a new heading whenever a row has a new column."""
    columns: list[str] = []
    for row in rows:
        if not set(row) <= set(columns):
            columns = list(row)
            print(f"\n| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
        print("|", " | ".join(shown(row.get(column)) for column in columns), "|", flush=True)


def parser(documentation: str | None) -> ArgumentParser:
    """Return a parser that prints a script's docstring for --help."""
    return ArgumentParser(description=documentation, formatter_class=RawDescriptionHelpFormatter)


def heading() -> None:
    """Print a script's command, the date and the machine as the heading of its tables."""
    name, *words = sys.argv
    print(
        f"# {Path(name).name}\n\n```sh\n{shlex.join([f'scripts/{Path(name).name}', *words])}\n```\n"
    )
    host = machine()
    print(
        f"{datetime.date.today()}, msmpetsc {__version__}, {host['cpu']}, {host['cores']} cores.",
        flush=True,
    )
