"""What a run is asked for: a frozen request, made of the command line and of the run that it goes on from."""

import argparse
import shlex
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

from msmpetsc.cli.arguments import MEASURE_NAMES, PAGE_NAMES, RESULT_NAMES, refuse_below_one, refuse_other_format
from msmpetsc.cli.running.resume import examined, options_to_keep
from msmpetsc.comm import on_root
from msmpetsc.errors import InputError
from msmpetsc.model.fields import Frame
from msmpetsc.output.restart import Earlier
from msmpetsc.scene.schema import Scene


@dataclass(frozen=True)
class RunRequest:
    """What a run is asked for: the options of ``msmpetsc run`` by their names.

    petsc_options : words of PETSc's options
    command       : the command line, as the result file and ``--measure`` record it
    made, on_frame : from Python alone: the scene itself in place of its file, and what is called with each frame
    """

    scene: Path | None = None
    output: Path | None = None
    preset: str | None = None
    error: str | None = None
    device: str | None = None
    frames: int | None = None
    set: tuple[str, ...] = ()
    picture: bool = False
    overwrite: bool = False
    resume: Path | None = None
    force: bool = False
    checkpoint_every: str | None = None
    compress: bool = False
    true_error: int | None = None
    trace: int | None = None
    measure: Path | None = None
    watch: Path | None = None
    petsc_options: tuple[str, ...] = ()
    command: str = "msmpetsc run"
    made: Scene | None = None
    on_frame: Callable[[Frame], object] | None = None

    @classmethod
    def from_args(cls, args: argparse.Namespace) -> "RunRequest":
        """Make the request of a command line. Raises InputError."""
        given: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in vars(args).items()
            if name in {field.name for field in fields(cls)}
        }
        return cls(**given | {"command": shlex.join(["msmpetsc", *args.words])})

    def __post_init__(self) -> None:
        """Raise InputError for options that contradict each other, or name files of other formats."""
        refuse_other_format("-o", self.output, RESULT_NAMES)
        refuse_other_format("--measure", self.measure, MEASURE_NAMES)
        refuse_other_format("--watch", self.watch, PAGE_NAMES)
        if self.resume and (self.overwrite or self.output not in (None, self.resume)):
            raise InputError("--resume goes on in its own file: -o and --overwrite have no place beside it")
        refuse_below_one(true_error=self.true_error, trace=self.trace, frames=self.frames)
        if self.made and not (self.output or self.resume):
            raise InputError("a scene that is no file gives its result no name: say output")
        if self.trace is not None and self.measure is None:
            raise InputError("--trace needs --measure, the file that it is written to")

    @property
    def path(self) -> Path:
        """Path of the result file."""
        if self.resume:
            return self.resume
        return self.output or Path("out") / f"{self.scene.stem if self.scene else ''}.h5"

    def going_on_from(self, earlier: Earlier | None) -> "RunRequest":
        """Return the request with what the earlier run was asked for and this one is not. Raises InputError."""
        if earlier is None:
            return self
        kept = options_to_keep(earlier, self.petsc_options)
        true_error = self.true_error or earlier.true_error or None
        return replace(self, petsc_options=(*kept, *self.petsc_options), true_error=true_error)


def earlier_run(comm: MPI.Comm, request: RunRequest) -> Earlier | None:
    """Return what is to be resumed, None for a run from the start (collective). Raises InputError."""
    if request.resume is None:
        if request.scene is None and request.made is None:
            raise InputError("a SCENE is needed, or --resume OUT.h5")
        return None
    path = request.resume
    if (request.scene or request.made) and not comm.bcast(on_root(comm, path.exists)):
        refuse_other_format("--resume", path, RESULT_NAMES)
        return None  # the first start of a job that may be started again
    return comm.bcast(on_root(comm, lambda: examined(path)))
