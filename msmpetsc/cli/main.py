"""The front doors: the command line, whose failures are one line and an exit status, and the same from Python."""

import dataclasses
import logging
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msmpetsc.cli.arguments import parsed, parsed_apart
from msmpetsc.cli.ranks import world
from msmpetsc.errors import InputError, MsmpetscError, as_expected, did_you_mean
from msmpetsc.scene.toml import overrides_of

if TYPE_CHECKING:  # MPI takes 0.3 s to start, which --help need not wait for
    from mpi4py import MPI

    from msmpetsc.model.fields import Frame
    from msmpetsc.scene.schema import Scene

DRAWING = ("render", "export", "compare")  # which the extra "render" is enough for
LINE = "msmpetsc: %(levelname)s: %(message)s"


class TimedFormatter(logging.Formatter):
    """Formats a line of the log with the seconds since the program started."""

    def format(self, record: logging.LogRecord) -> str:
        record.levelname = f"{record.levelname} [{record.relativeCreated / 1000:.2f} s]"
        return super().format(record)


def main(arguments: list[str] | None = None) -> int:
    """Run one command; return 0, 2 for bad input, 3 for a step that failed (collective)."""
    words = sys.argv[1:] if arguments is None else arguments
    refused, verbose, level = None, False, logging.INFO
    try:
        args = parsed(words)  # --help and --version leave from here
        verbose, level = args.verbose, logging.WARNING if args.quiet else logging.INFO
    except InputError as error:
        refused = error
    from msmpetsc.cli.failure import STATUS_BUG, STATUS_INTERRUPTED, ending_together

    comm = world(started=refused is None and args.command == "run")  # the other commands are for one process
    with logged_on_root(comm, level, verbose):
        try:
            with ending_together(comm, "render" if refused is None and args.command in DRAWING else "run"):
                if refused is not None:
                    raise refused
                return import_module(f"msmpetsc.cli.commands.{args.command}").run(args)
        except MsmpetscError as error:
            if comm.rank == 0:
                if verbose:
                    traceback.print_exc()
                print(f"msmpetsc: error: {error}", file=sys.stderr)
            return error.exit_status
        except KeyboardInterrupt:
            print("msmpetsc: rank 0: interrupted", file=sys.stderr, flush=True)
            return STATUS_INTERRUPTED
        except Exception:
            print(f"msmpetsc: rank 0: {traceback.format_exc()}", file=sys.stderr, flush=True)
            return STATUS_BUG


def entry_point() -> None:
    """Be the installed ``msmpetsc``; where only results can be read, one line says what a run needs."""
    try:
        status = main()
    except ModuleNotFoundError as error:
        expected = as_expected(error)
        if expected is None:
            raise
        print(f"msmpetsc: error: {expected}", file=sys.stderr)
        status = expected.exit_status
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done: one more could only spoil the status
    sys.exit(status)


def simulate(
    scene: "str | os.PathLike[str] | Mapping[str, Any] | Scene | None" = None,
    output: str | os.PathLike[str] | None = None,
    *,
    petsc_options: str | Mapping[str, Any] = "",
    quiet: bool = False,
    on_frame: "Callable[[Frame], object] | None" = None,
    **options: Any,
) -> Path:
    """Run a scene as ``msmpetsc run`` does, and return the path of its result (collective).

    scene         : a file's path; or a Scene, or its tables, which give the result no name: output does
    on_frame      : called on all ranks with each frame, once that is written
    petsc_options : "-ksp_rtol 1e-3 -ksp_view", or {"ksp_rtol": 1e-3, "ksp_view": None}; for this run alone
    quiet         : print no notes and no progress; warnings stay
    options       : those of the command by their names: frames=10, checkpoint_every="5min", set={"cages.count": 3000}

    Raises InputError and StepFailed on all ranks. Stopped by a signal, the run leaves a file that resume="OUT.h5"
    takes up, and raises what Python raises there: KeyboardInterrupt for SIGINT, SystemExit for SIGTERM.
    """
    from mpi4py import MPI

    from msmpetsc.cli.commands.run import RunRequest, run
    from msmpetsc.cli.failure import STATUS_INTERRUPTED, ending_together
    from msmpetsc.scene.schema import Scene
    from msmpetsc.solve.petsc.words import start_for_runs, words_of

    comm = MPI.COMM_WORLD
    with logged_on_root(comm, logging.WARNING if quiet else logging.INFO), ending_together(comm):
        valid = {field.name for field in dataclasses.fields(RunRequest)} - {"petsc_options", "command", "made"}
        for name in options.keys() - valid:
            raise InputError(f"run has no option {name!r}{did_you_mean(name, valid)}")
        made = Scene.of(scene) if isinstance(scene, Mapping) else scene
        positional = [] if made is None or isinstance(made, Scene) else [os.fspath(made)]
        named = {"output": output, **options}
        ours = ["run", *positional, *(word for item in named.items() for word in command_words(*item))]
        petsc = words_of(petsc_options)
        args = parsed_apart(ours, petsc, [*ours, *petsc])
        args.made, args.on_frame = None if positional else made, on_frame
        start_for_runs(comm, petsc)
        status = run(args)
    if status:
        raise KeyboardInterrupt if status == STATUS_INTERRUPTED else SystemExit(status)
    return RunRequest.from_args(args).path


def command_words(name: str, value: Any) -> list[str]:
    """Return the words of the command line that say the same as a keyword argument."""
    option = f"--{name.replace('_', '-')}"
    if value is None or value is False:
        return []
    if value is True:
        return [option]
    if isinstance(value, Mapping):
        value = overrides_of(value)
    values = value if isinstance(value, list | tuple) else [value]
    return [f"{option}={one_value}" for one_value in values]


@contextmanager
def logged_on_root(comm: "MPI.Comm", level: int = logging.INFO, timed: bool = False) -> Iterator[None]:
    """Let rank 0 alone write the log to stderr, from this level on, ``timed`` with the seconds since the start."""
    log = logging.getLogger("msmpetsc")
    before = log.handlers, log.level
    logging.addLevelName(logging.WARNING, "warning")
    logging.addLevelName(logging.INFO, "note")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter((TimedFormatter if timed else logging.Formatter)(LINE))
    log.handlers = [handler]
    log.setLevel(level if comm.rank == 0 else logging.CRITICAL)
    try:
        yield
    finally:
        log.handlers = before[0]
        log.setLevel(before[1])


if __name__ == "__main__":
    entry_point()
