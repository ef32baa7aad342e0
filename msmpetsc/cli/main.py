"""The command line: finds the command, and turns every failure into one line and an exit status."""

import argparse
import logging
import signal
import sys
import traceback
from itertools import pairwise

from mpi4py import MPI

from msmpetsc import __version__
from msmpetsc.cli import compare, fetch, inspect, plan, render, run, study
from msmpetsc.comm import log
from msmpetsc.errors import InputError, MsmpetscError, did_you_mean

COMMANDS = (run, inspect, study, plan, compare, render, fetch)
OUR_SHORT = ("-o", "-h")
STATUS_BUG, STATUS_INTERRUPTED = 1, 130


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns 0, 2 for bad input, 3 for a step that failed (collective)."""
    comm = MPI.COMM_WORLD
    _speak_on_root(comm)
    try:
        ours, petsc = split_petsc_options(sys.argv[1:] if arguments is None else arguments)
        args = _parser().parse_args(ours)
        if petsc and not args.takes_petsc_options:
            raise InputError(f"{petsc[0]}: {args.command} takes no PETSc options")
        args.petsc_options = petsc
        return args.run(args)
    except MsmpetscError as error:
        if comm.rank == 0:
            print(f"msmpetsc: error: {error}", file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        return _stop_all_ranks(comm, STATUS_INTERRUPTED, "interrupted")
    except Exception:
        return _stop_all_ranks(comm, STATUS_BUG, traceback.format_exc())


def entry_point() -> None:
    """Entry point of the installed ``msmpetsc``."""
    status = main()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done: one more could only spoil the status
    sys.exit(status)


def split_petsc_options(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Ours, and PETSc's: those of one dash, each with the value that follows it, as PETSc itself reads them."""
    ours, petsc = [], []
    for before, word in pairwise(["", *arguments]):
        ends_it = word.startswith("--") or word in OUR_SHORT or word.endswith(".toml")
        value = _is_petsc_option(before) and not ends_it
        (petsc if value or _is_petsc_option(word) else ours).append(word)
    return ours, petsc


def _is_petsc_option(word: str) -> bool:
    return len(word) > 1 and word[0] == "-" and word[1].isalpha() and word not in OUR_SHORT


class _Parser(argparse.ArgumentParser):
    """Speaks on rank 0 only, and names the nearest option for one it does not know."""

    def error(self, message: str) -> None:
        raise InputError(message)

    def _print_message(self, message: str, file=None) -> None:  # where argparse prints help and version
        if MPI.COMM_WORLD.rank == 0:
            super()._print_message(message, file)

    def parse_args(self, arguments: list[str]) -> argparse.Namespace:
        args, unknown = self.parse_known_args(arguments)
        if unknown:
            valid = list(args.parser._option_string_actions)
            raise InputError(f"{args.command}: unknown argument {unknown[0]}{did_you_mean(unknown[0], valid)}")
        return args


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="msmpetsc", description=__import__("msmpetsc").__doc__)
    parser.add_argument("--version", action="version", version=f"msmpetsc {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add_parser(commands)
        sub = commands.choices[command.__name__.rpartition(".")[2]]
        sub.set_defaults(run=command.run, parser=sub, takes_petsc_options=command in (run, inspect))
    return parser


def _speak_on_root(comm: MPI.Comm) -> None:
    log.handlers = [logging.StreamHandler(sys.stderr)]
    log.handlers[0].setFormatter(logging.Formatter("msmpetsc: %(levelname)s: %(message)s"))
    logging.addLevelName(logging.WARNING, "warning")
    logging.addLevelName(logging.INFO, "note")
    log.setLevel(logging.INFO if comm.rank == 0 else logging.CRITICAL)


def _stop_all_ranks(comm: MPI.Comm, status: int, message: str) -> int:
    """What no rank foresaw: the others may wait for this one for ever, so they are aborted."""
    print(f"msmpetsc: rank {comm.rank}: {message}", file=sys.stderr, flush=True)
    if comm.size > 1:
        comm.Abort(status)
    return status


if __name__ == "__main__":
    entry_point()
