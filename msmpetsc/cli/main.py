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
from msmpetsc.cli.failure import STATUS_BUG, STATUS_INTERRUPTED, ending_together
from msmpetsc.comm import log
from msmpetsc.errors import InputError, MsmpetscError, did_you_mean

COMMANDS = (run, inspect, study, plan, compare, render, fetch)
OUR_SHORT = ("-o", "-h")


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns 0, 2 for bad input, 3 for a step that failed (collective)."""
    comm = MPI.COMM_WORLD
    _speak_on_root(comm)
    try:
        with ending_together(comm):
            args = parsed(sys.argv[1:] if arguments is None else arguments)
            return args.run(args)
    except MsmpetscError as error:
        if comm.rank == 0:
            print(f"msmpetsc: error: {error}", file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        print("msmpetsc: rank 0: interrupted", file=sys.stderr, flush=True)
        return STATUS_INTERRUPTED
    except Exception:
        print(f"msmpetsc: rank 0: {traceback.format_exc()}", file=sys.stderr, flush=True)
        return STATUS_BUG


def entry_point() -> None:
    """Entry point of the installed ``msmpetsc``."""
    status = main()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done: one more could only spoil the status
    sys.exit(status)


def parsed(arguments: list[str]) -> argparse.Namespace:
    """All that the command is told. Raises InputError."""
    ours, petsc = split_petsc_options(arguments)
    parser = _parser()
    _refuse_one_dash(parser, ours, petsc)
    args = parser.parse_args(ours)
    if petsc and not args.takes_petsc_options:
        raise InputError(f"{petsc[0]}: {args.command} takes no PETSc options")
    args.petsc_options = petsc
    return args


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


def _refuse_one_dash(parser: argparse.ArgumentParser, ours: list[str], petsc: list[str]) -> None:
    """Raise InputError for options of ours that have lost a dash, and for any of PETSc's where there is no use for them."""
    command = parser.get_default("commands").choices.get(ours[0] if ours else "")
    if command is None:  # argparse says so
        return
    takes_them, known = command.get_default("takes_petsc_options"), command._option_string_actions
    for word in petsc:
        name = f"-{word.partition('=')[0]}"
        if name in known and not (takes_them and name == "--help"):  # PETSc has a -help, too
            raise InputError(f"{word}: options of one dash are PETSc's, did you mean {name!r}?")
    if petsc and not takes_them:
        raise InputError(f"{petsc[0]}: {ours[0]} takes no PETSc options{did_you_mean(f'-{petsc[0]}', known)}")


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
    parser.set_defaults(commands=commands)
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


if __name__ == "__main__":
    entry_point()
