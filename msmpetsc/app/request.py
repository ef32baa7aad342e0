"""The table of the options of a run.

It defines the keywords of ``msmpetsc.run``, the options of ``msmpetsc run``, their help, and the
table of options in the documentation (scripts/docs/pages/reference/command-line.md).
"""

# ruff: noqa: RUF009

import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from msmpetsc.app.checks import (
    MEASURE_NAMES,
    RESULT_NAMES,
    checked_file,
    checked_path,
    refuse_other_format,
)
from msmpetsc.errors import InputError, printable
from msmpetsc.scene.toml import overrides_of
from msmpetsc.solve.petsc.words import words_of

# not imported at run time, so that --help starts quickly
if TYPE_CHECKING:
    from msmpetsc.fields import Frame
    from msmpetsc.scene.reading import Scene

File = str | os.PathLike[str]
# types of options that argparse does not convert, and that Python may mistake
KINDS: dict[str, tuple[type, ...]] = {
    "set": (Mapping, Sequence),
    "petsc_options": (str, Mapping),
}
# largest whole number of an option [-]; a double holds every whole number up to it
MOST = 2**53


class Option(NamedTuple):
    """Help and command line syntax of a field of the request.

    short    : alternative name with a single dash, if any
    python   : whether the option is for Python only, or takes another form on the command line
    keywords : further keywords of the argument for argparse
    """

    help: str
    short: tuple[str, ...]
    python: bool
    keywords: dict[str, Any]


def given(default: Any, help: str, /, *short: str, python: bool = False, **keywords: Any) -> Any:
    """Return a dataclass field with its default and its option as metadata."""
    return field(default=default, metadata={"option": Option(help, short, python, keywords)})


@dataclass(frozen=True)
class RunRequest:
    """The options of a run."""

    scene: "File | Mapping[str, Any] | Scene | None" = given(
        None,
        "scene file (TOML); in Python also a Scene or its tables",
        nargs="?",
        metavar="SCENE",
        type=checked_file,
    )
    output: File | None = given(
        None,
        "result file, .h5 or .hdf5; default: out/SCENE.h5",
        "-o",
        metavar="OUT.h5",
        type=checked_file,
    )
    _: KW_ONLY
    preset: str | None = given(None, "solver preset (see --list-presets)", metavar="NAME")
    error: float | None = given(None, "target relative error of a step", metavar="E", type=float)
    device: Literal["cpu", "cuda"] | None = given(
        None, "device: CPU, or CUDA GPU (-mat_type aijcusparse)", choices=("cpu", "cuda")
    )
    frames: int | None = given(None, "stop after N steps", metavar="N", type=int)
    set: Mapping[str, Any] | Sequence[str] = given(
        (),
        "override scene keys: cages.count=3000, obstacle.0.friction=0.5",
        metavar="KEY=VALUE",
        action="append",
        default=[],
    )
    picture: bool = given(False, "draw a few frames into OUT.png", action="store_true")
    overwrite: bool = given(False, "replace OUT.h5 if it exists", action="store_true")
    resume: File | None = given(
        None,
        "continue the stopped run that wrote this file; with SCENE, start it if there is no "
        "file yet",
        metavar="OUT.h5",
        type=checked_file,
    )
    force: bool = given(
        False, "resume with a changed scene or changed options", action="store_true"
    )
    checkpoint_every: int | None = given(
        None,
        "frames between checkpoints; default: so that they take at most 1% of the time",
        metavar="N",
        type=int,
    )
    true_error: int | None = given(
        None,
        "solve every N-th step to rounding as well and store its true error",
        metavar="N",
        type=int,
    )
    measure: File | None = given(
        None,
        "write the cost of the run: times, products, memory, machine",
        metavar="OUT.json",
        type=checked_file,
    )
    export: File | None = given(
        None,
        "write the first linear system of chosen steps into DIR/step_N, for other solvers",
        metavar="DIR",
        type=checked_path,
    )
    export_steps: str = given(
        "", "steps whose systems --export writes; default: 1", metavar="1,5,20"
    )
    petsc_options: str | Mapping[str, Any] = given(
        "",
        'PETSc options of this run: "-ksp_rtol 1e-3 -ksp_view", or {"ksp_rtol": 1e-3}',
        python=True,
    )
    quiet: bool = given(False, "show only warnings and errors", python=True)
    on_frame: "Callable[[Frame], object] | None" = given(
        None, "function called on all ranks with each frame after it is written", python=True
    )

    def __post_init__(self) -> None:
        """Raise InputError for invalid paths, numbers and contradictory options."""
        for name, option in OPTIONS.items():
            value = getattr(self, name)
            kind, choices = (option.keywords.get(key) for key in ("type", "choices"))
            if isinstance(value, str | os.PathLike) and kind in (checked_path, checked_file):
                kind(os.fspath(value))
            # argparse has converted words; Python may pass any type
            if kind is int and not isinstance(value, Integral | None):
                raise InputError(f"{flag_of(name)} must be a whole number, not {value!r}")
            if kind is int and value is not None and value < 1:
                raise InputError(f"{flag_of(name)} must be at least 1, not {value}")
            if kind is int and value is not None and value > MOST:
                raise InputError(f"{flag_of(name)} must be at most {MOST}, not {value}")
            if choices and value not in (None, *choices):
                raise InputError(f"{flag_of(name)} is {' or '.join(choices)}, not {value!r}")
        for name, kinds in KINDS.items():
            if not isinstance(value := getattr(self, name), kinds):
                said = " or ".join(kind.__name__ for kind in kinds)
                raise InputError(f"{name} must be {said}, not {printable(repr(value), 60)}")
        refuse_other_format("-o", self.output, RESULT_NAMES)
        refuse_other_format("--measure", self.measure, MEASURE_NAMES)
        if self.export_steps and not self.export:
            raise InputError("--export-steps chooses steps of --export DIR, which is missing")
        steps_in(self.export_steps)
        differs = (
            self.output is not None
            and self.resume is not None
            and Path(self.output) != Path(self.resume)
        )
        if self.resume and (self.overwrite or differs):
            raise InputError("--resume continues its own file: leave out -o and --overwrite")
        if self.scene is not None and not (self.file or self.output or self.resume):
            raise InputError("a scene without a file gives its result no name: say output")

    @property
    def file(self) -> Path | None:
        """Return the path of the scene file; None for a scene from Python."""
        return Path(self.scene) if isinstance(self.scene, str | os.PathLike) else None

    @property
    def path(self) -> Path:
        """Return the path of the result file."""
        given_path = self.resume or self.output
        if given_path:
            return Path(given_path)
        return Path("out") / f"{self.file.stem if self.file else ''}.h5"

    @property
    def measured(self) -> Path | None:
        """Return the path of the cost file; None if the cost is not measured."""
        return Path(self.measure) if self.measure else None

    @property
    def exported(self) -> tuple[int, ...]:
        """Return the numbers of the steps whose linear systems are exported."""
        return steps_in(self.export_steps) if self.export else ()

    @property
    def overrides(self) -> list[str]:
        """Return the changes of the scene as values of ``--set``."""
        given = {"solver.preset": self.preset, "solver.error": self.error}
        method = {key: value for key, value in given.items() if value is not None}
        return [*overrides_of(method), *overrides_of(self.set)]

    @property
    def command(self) -> str:
        """Return the equivalent command line, for result and cost files."""
        words = ["msmpetsc", "run", *([str(self.file)] if self.file else [])]
        for name, option in OPTIONS.items():
            value = getattr(self, name)
            if option.python or name == "scene" or not value:
                continue
            values = overrides_of(value) if isinstance(value, Mapping) else value
            if value is True:
                words.append(flag_of(name))
            else:
                several = values if isinstance(values, list | tuple) else [values]
                words += [f"{flag_of(name)}={item}" for item in several]
        return shlex.join([*words, *self.petsc_words])

    @property
    def petsc_words(self) -> list[str]:
        """Return the PETSc options as words. Raises InputError for an invalid option."""
        return words_of(self.petsc_options)


def steps_in(text: str) -> tuple[int, ...]:
    """Return the numbers of steps in a text like "1,5,20"; the first step for "".

    Raises InputError.
    """
    words = [word.strip() for word in str(text or 1).split(",")]
    if not all(word.isdecimal() and 0 < int(word) < 10**9 for word in words):
        said = printable(str(text), 40)
        raise InputError(f"--export-steps takes numbers like 1,5,20, not {said!r}")
    return tuple(map(int, words))


def flag_of(name: str) -> str:
    """Return the command line option of a field, for example "--true-error"."""
    return f"--{name.replace('_', '-')}"


OPTIONS: dict[str, Option] = {each.name: each.metadata["option"] for each in fields(RunRequest)}
