"""What a run can be asked for: the one table of it.

Of its rows are made the keywords of ``msmpetsc.run`` with their types and their help, the options
of ``msmpetsc run``, and the table of options in README.
"""

# ruff: noqa: RUF009  # a call of given() is a field, made once

import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from msmpetsc.app.checks import (
    MEASURE_NAMES,
    RESULT_NAMES,
    checked_file,
    checked_path,
    refuse_other_format,
)
from msmpetsc.errors import InputError
from msmpetsc.scene.toml import overrides_of
from msmpetsc.solve.petsc.words import words_of

if TYPE_CHECKING:  # --help, which shows the table, needs neither numpy nor a scene
    from msmpetsc.fields import Frame
    from msmpetsc.scene.reading import Scene

File = str | os.PathLike[str]


@dataclass(frozen=True)
class Option:
    """What is said of a field of the request, and how the command line takes it.

    value   : what stands for its value on the command line; "" for a switch
    kind    : makes the value of a word
    choices : all the values there are
    short   : another name, of one dash
    python  : whether Python alone takes it, or the command line in another way
    """

    help: str
    value: str = ""
    kind: Callable[[str], Any] = str
    choices: tuple[str, ...] | None = None
    short: str = ""
    python: bool = False


def given(default: Any, option: Option) -> Any:
    """Return a field of the request with its default and with what is said of it."""
    return field(default=default, metadata={"option": option})


@dataclass(frozen=True)
class RunRequest:
    """A run that is asked for."""

    scene: "File | Mapping[str, Any] | Scene | None" = given(
        None,
        Option("scene file (TOML); in Python a Scene, too, or its tables", "SCENE", checked_path),
    )
    output: File | None = given(
        None,
        Option(
            "result file, .h5 or .hdf5; out/SCENE.h5 if not given",
            "OUT.h5",
            checked_file,
            short="-o",
        ),
    )
    _: KW_ONLY
    preset: str | None = given(None, Option("solver preset (see --list-presets)", "NAME"))
    error: float | None = given(None, Option("relative error at which a step is done", "E", float))
    device: Literal["cpu", "cuda"] | None = given(
        None,
        Option(
            "where to compute: cuda is -mat_type aijcusparse, a CUDA GPU", choices=("cpu", "cuda")
        ),
    )
    frames: int | None = given(None, Option("stop after N steps", "N", int))
    set: Mapping[str, Any] | Sequence[str] = given(
        (), Option("override scene keys: cages.count=3000, obstacle.0.friction=0.5", "KEY=VALUE")
    )
    picture: bool = given(False, Option("also draw a few moments: OUT.png"))
    overwrite: bool = given(False, Option("replace OUT.h5 if it exists"))
    resume: File | None = given(
        None,
        Option(
            "go on where the run that wrote this file was stopped; with SCENE, start it if there is no such file yet",
            "OUT.h5",
            checked_file,
        ),
    )
    force: bool = given(False, Option("resume with another scene or other options than before"))
    checkpoint_every: int | None = given(
        None,
        Option(
            "frames from one checkpoint to the next; default: as take 1% of the time at most",
            "N",
            int,
        ),
    )
    gather: bool = given(
        False,
        Option("let rank 0 write for all: where nodes of a cluster do not see one file alike"),
    )
    true_error: int | None = given(
        None, Option("also solve every N-th step to rounding, and store its true error", "N", int)
    )
    measure: File | None = given(
        None,
        Option(
            "write what the run cost: times, products, memory, machine", "OUT.json", checked_file
        ),
    )
    petsc_options: str | Mapping[str, Any] = given(
        "",
        Option(
            'PETSc\'s options, for this run alone: "-ksp_rtol 1e-3 -ksp_view", {"ksp_rtol": 1e-3}',
            python=True,
        ),
    )
    quiet: bool = given(
        False, Option("no notes and no progress; warnings and errors stay", python=True)
    )
    on_frame: "Callable[[Frame], object] | None" = given(
        None, Option("called on all ranks with each frame, once that is written", python=True)
    )

    def __post_init__(self) -> None:
        """Raise InputError for what cannot be meant: paths, numbers, and options that contradict each other."""
        for name, option in OPTIONS.items():
            value = getattr(self, name)
            if isinstance(value, str | os.PathLike) and option.kind in (checked_path, checked_file):
                option.kind(os.fspath(value))
            if option.kind is int and not isinstance(
                value, Integral | None
            ):  # Python alone can give it
                raise InputError(f"{flag_of(name)} must be a whole number, not {value!r}")
            if option.kind is int and value is not None and value < 1:
                raise InputError(f"{flag_of(name)} must be at least 1, not {value}")
            if option.choices and value not in (None, *option.choices):
                raise InputError(f"{flag_of(name)} is {' or '.join(option.choices)}, not {value!r}")
        refuse_other_format("-o", self.output, RESULT_NAMES)
        refuse_other_format("--measure", self.measure, MEASURE_NAMES)
        other = (
            self.output is not None
            and self.resume is not None
            and Path(self.output) != Path(self.resume)
        )
        if self.resume and (self.overwrite or other):
            raise InputError(
                "--resume goes on in its own file: -o and --overwrite have no place beside it"
            )
        if self.scene is not None and not (self.file or self.output or self.resume):
            raise InputError("a scene that is no file gives its result no name: say output")

    @property
    def file(self) -> Path | None:
        """Return the path of the scene, if that is a file."""
        return Path(self.scene) if isinstance(self.scene, str | os.PathLike) else None

    @property
    def path(self) -> Path:
        """Return the path of the result file."""
        named = self.resume or self.output
        return Path(named) if named else Path("out") / f"{self.file.stem if self.file else ''}.h5"

    @property
    def measured(self) -> Path | None:
        """Return the path of the file of what the run cost."""
        return Path(self.measure) if self.measure else None

    @property
    def overrides(self) -> list[str]:
        """Return the changes of the scene, as ``--set`` takes them."""
        given = {"solver.preset": self.preset, "solver.error": self.error}
        method = {key: value for key, value in given.items() if value is not None}
        return [*overrides_of(method), *overrides_of(self.set)]

    @property
    def command(self) -> str:
        """Return the command that asks for the same, as result files and ``--measure`` have it."""
        words = ["msmpetsc", "run", *([str(self.file)] if self.file else [])]
        for name, option in OPTIONS.items():
            value = getattr(self, name)
            if option.python or name == "scene" or not value:
                continue
            values = overrides_of(value) if isinstance(value, Mapping) else value
            several = values if isinstance(values, list | tuple) else [values]
            words += (
                [flag_of(name)]
                if value is True
                else [f"{flag_of(name)}={each}" for each in several]
            )
        return shlex.join([*words, *self.petsc_words])

    @property
    def petsc_words(self) -> list[str]:
        """Return PETSc's options as words. Raises InputError for what is no option."""
        return words_of(self.petsc_options)


def flag_of(name: str) -> str:
    """Return the option of the command line for a field: "--true-error"."""
    return f"--{name.replace('_', '-')}"


OPTIONS: dict[str, Option] = {each.name: each.metadata["option"] for each in fields(RunRequest)}
