"""The entry point of the command line, which reports failures in one line and an exit status."""

import argparse
import logging
import os
import signal
import sys
import traceback
from importlib import import_module

from msmpetsc.app.ending import STATUS_BUG, STATUS_INTERRUPTED, ending_together, logged_on_root
from msmpetsc.cli.arguments import parsed
from msmpetsc.cli.command_table import COMMANDS
from msmpetsc.cli.ranks import world
from msmpetsc.errors import InputError, MsmpetscError, as_expected

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
                return carry_out(args, comm.size)
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


def carry_out(args: argparse.Namespace, ranks: int) -> int:
    """Carry out a command on so many ranks; return its exit status. Raises InputError where it is for one."""
    command = COMMANDS[args.command]
    if ranks > 1 and args.command != "run":
        raise InputError(f"{args.command} is for one process: start it without mpiexec")
    if command.starts_runs:  # SIGTERM ends those, too, as Ctrl-C does
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    status: int = import_module(f"msmpetsc.cli.commands.{command.module or args.command}").run(args)
    return status


def entry_point() -> None:
    """Run the installed ``msmpetsc``, and name in one line a package that a command lacks.

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
