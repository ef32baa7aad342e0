"""A case: one run of a scene, all that defines it, and the command that runs it."""

import hashlib
import json
import os
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from msmpetsc import __version__
from msmpetsc.study.forkserver import COLD

NOT_ITS_IDENTITY = ("file", "label", "timeout", "reference", "place")


@dataclass(frozen=True)
class Place:
    """Where a case stands in a map, and whether its body should be in its rest shape at the end."""

    map: str
    x: str | float
    y: str | float
    recovers: bool = False


@dataclass(frozen=True)
class Case:
    """One run, repeated.

    content    : digest of the scene file and of the files that it names
    set        : all overrides, "key.path=value", as --set takes them; what follows repeats them for the table
    error, max_iterations, cells, substep : None where the scene or the program decides
    preset     : "" for verlet
    true_error : every so many steps the true step error is measured; None for never
    trace      : the step that is followed; None for none
    reference  : the run its motion is measured against
    place      : in a map; None for the case of a sweep
    """

    scene: str
    file: Path
    content: str
    set: tuple[str, ...]
    integrator: str
    preset: str
    options: str
    cells: int | None
    time_step: float  # [s]
    substep: float | None  # [s]
    error: float | None
    max_iterations: int | None
    ranks: int = 1
    repeats: int = 1
    true_error: int | None = None
    trace: int | None = None
    label: str = ""
    timeout: float = 300.0  # [s]
    reference: "Case | None" = None
    place: Place | None = None

    @property
    def id(self) -> str:
        """The same for the same run, whatever it is called, however long it may take."""
        what = {name: value for name, value in asdict(self).items() if name not in NOT_ITS_IDENTITY}
        what |= {"version": __version__, "reference": self.reference and self.reference.id}
        what |= {"place": asdict(self.place)} if self.place else {}
        return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def work(self) -> float:
        """A guess, in cells: a process counts as 10^4 of them, and so does a scene that names none."""
        return self.repeats * (1e4 + (self.cells or 1e4))

    def unmeasured(self) -> "Case":
        """The same run without what is measured beside it."""
        return replace(self, true_error=None, trace=None)


def run_arguments(case: Case) -> list[str]:
    """What follows ``msmpetsc``, outputs aside."""
    changes = [word for change in case.set for word in ("--set", change)]
    measured = [("--true-error", case.true_error), ("--trace", case.trace)]
    extra = [word for name, value in measured if value is not None for word in (name, str(value))]
    return ["run", os.path.relpath(case.file), *changes, *extra, *shlex.split(case.options)]


def launcher(ranks: int) -> list[str]:
    return ["mpiexec", "-n", str(ranks)] if ranks > 1 else []


def command(case: Case, result: Path, measure: Path) -> list[str]:
    """The process of one run: its frames go to ``result``, its figures to ``measure``."""
    outputs = ["-o", str(result), "--overwrite", "--measure", str(measure)]
    # before PETSc's options: the last of these may be one without a value
    name, scene, *rest = run_arguments(case)
    return [*launcher(case.ranks), *COLD, name, scene, *outputs, *rest]


def shown_command(case: Case) -> str:
    """The line that repeats the case by hand."""
    return shlex.join([*launcher(case.ranks), "msmpetsc", *run_arguments(case)])


def digest(scene: Path, names: Sequence[str]) -> str:
    """Of a scene file and of those ``names`` in it that are files beside it."""
    files = [scene, *(scene.parent / name for name in sorted(set(names)))]
    found = [path.read_bytes() for path in files if path.is_file()]
    return hashlib.sha256(b"\0".join(found)).hexdigest()[:16]
