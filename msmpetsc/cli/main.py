"""The command line, whose failures are one line and an exit status."""

import argparse
import logging
import os
import signal
import sys
import traceback
from importlib import import_module
from typing import TYPE_CHECKING

from msmpetsc.app.ending import STATUS_BUG, STATUS_INTERRUPTED, ending_together, logged_on_root
from msmpetsc.cli.arguments import parsed
from msmpetsc.cli.command_table import COMMANDS, RUNS_ITSELF
from msmpetsc.cli.ranks import world
from msmpetsc.errors import InputError, MsmpetscError, as_expected

if TYPE_CHECKING:
    from mpi4py import MPI

DRAWING = ("render", "export", "compare")  # which the extra "render" is enough for


def main(arguments: list[str] | None = None) -> int:
    """Run one command; return 0, 2 for bad input, 3 for a step that failed (collective)."""
    words = sys.argv[1:] if arguments is None else arguments
    refused = None
    args = argparse.Namespace(command="", quiet=False, verbose=False)
    try:
        args = parsed(words)  # --help and --version leave from here
    except InputError as error:
        refused = error
    comm = world(started=args.command == "run")  # the other commands are for one process
    level = logging.WARNING if args.quiet else logging.INFO
    with logged_on_root(comm, level, args.verbose):
        try:
            with ending_together(comm, "render" if args.command in DRAWING else "run"):
                if refused is not None:
                    raise refused
                command = COMMANDS[args.command]
                if command.alone:
                    start_alone(comm, args.command, command.alone)
                return import_module(f"msmpetsc.cli.commands.{command.module or args.command}").run(args)
        except MsmpetscError as error:
            if comm.rank == 0:
                if args.verbose:
                    traceback.print_exc()
                print(f"msmpetsc: error: {error}", file=sys.stderr)
            return error.exit_status
        except KeyboardInterrupt:
            print("msmpetsc: rank 0: interrupted", file=sys.stderr, flush=True)
            return STATUS_INTERRUPTED
        except BrokenPipeError:  # its reader went away: entry_point ends quietly
            raise
        except Exception:
            print(f"msmpetsc: rank 0: {traceback.format_exc()}", file=sys.stderr, flush=True)
            return STATUS_BUG


def start_alone(comm: "MPI.Comm", command: str, why: str) -> None:
    """Raise InputError where mpiexec has started more than one of a command that is for one process.

    SIGTERM to one that runs others ends those, too, as Ctrl-C does.
    """
    if comm.size > 1:
        raise InputError(f"{command} is started without mpiexec: {why}")
    if why == RUNS_ITSELF:
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def entry_point() -> None:
    """Entry point of the installed ``msmpetsc``; where only results can be read, one line says what a run needs.

    It ends quietly, as other programs do, when who reads what it prints goes away: ``msmpetsc doctor | head -1``.
    """
    try:
        try:
            status = main()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):  # what is left to be written, at the exit too, has no reader
            os.dup2(nowhere, stream.fileno())
        status = 128 + signal.SIGPIPE
    except ModuleNotFoundError as error:
        expected = as_expected(error)
        if expected is None:
            raise
        print(f"msmpetsc: error: {expected}", file=sys.stderr)
        status = expected.exit_status
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done: one more could only spoil the status
    sys.exit(status)


if __name__ == "__main__":
    entry_point()
