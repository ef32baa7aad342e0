"""The entry point of the command line: parse, run a command, report errors and exit status.

The imports at the top start neither MPI nor PETSc, so that ``--help`` is fast.
"""

import argparse
import logging
import os
import platform
import re
import shlex
import signal
import sys
import textwrap
import traceback
from argparse import RawDescriptionHelpFormatter
from contextlib import suppress
from importlib import import_module
from itertools import pairwise
from types import ModuleType
from typing import Any, NoReturn

import msmpetsc
from msmpetsc.app.abort import ending_together, logged_on_root
from msmpetsc.app.ranks import world
from msmpetsc.cli.command_table import COMMANDS, VERBOSITY, Shown
from msmpetsc.errors import STATUS_BUG, STATUS_INTERRUPTED, InputError, MsmpetscError, did_you_mean

# commands that need the packages of the extra "render" only
READING = ("render", "export", "compare", "series")
# commands that may use several ranks
ON_RANKS = ("run", "modes")
# options with a single dash that are not PETSc's
OUR_SHORT = ("-o", "-h")


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit status (collective)."""
    words = sys.argv[1:] if arguments is None else arguments
    args = argparse.Namespace(verbose=False)
    comm = world()
    try:
        with ending_together(comm):
            # --help and --version exit here
            args = parsed(words)
            comm = world(started=args.command in ON_RANKS)
        extra = "render" if args.command in READING else "run"
        level = logging.WARNING if args.quiet else logging.INFO
        with logged_on_root(comm, level, args.verbose), ending_together(comm, extra):
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
    # the reader of the output has gone: entry_point exits quietly
    except BrokenPipeError:
        raise
    except Exception:
        print(f"msmpetsc: rank 0: {traceback.format_exc()}", file=sys.stderr, flush=True)
        return STATUS_BUG


def carry_out(args: argparse.Namespace, ranks: int) -> int:
    """Run a command and return its exit status.

    Raises InputError on several ranks for a command that is for a single process.
    """
    command = COMMANDS[args.command]
    if ranks > 1 and args.command not in ON_RANKS:
        raise InputError(f"{args.command} is for one process: start it without mpiexec")
    module = _imported(f"msmpetsc.cli.commands.{command.module or args.command}")
    # SIGTERM then ends the runs that the command has started, as Ctrl-C does
    if command.starts_runs:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    status: int = module.run(args)
    return status


def _imported(name: str) -> ModuleType:
    """Return an imported module; let a SIGINT that comes meanwhile act afterwards.

    pydantic swallows an exception that a signal's handler raises while it builds a class.
    """
    interrupts: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
    try:
        module = import_module(name)
    finally:
        signal.signal(signal.SIGINT, before)
    if interrupts:
        signal.raise_signal(signal.SIGINT)
    return module


def entry_point() -> None:
    """Run the installed ``msmpetsc`` and exit.

    The program exits quietly if the reader of its output closes the pipe, as ``head -1`` does.
    """
    _open_closed_streams()
    try:
        try:
            status = main()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # discard buffered output, which Python would flush at exit
        devnull = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(devnull, stream.fileno())
        status = 128 + signal.SIGPIPE
    # a late signal must not change the exit status
    for number in (signal.SIGINT, signal.SIGUSR1):
        signal.signal(number, signal.SIG_IGN)
    sys.exit(status)


def _open_closed_streams() -> None:
    """Open the null device for each standard stream that is closed, as by ``2>&-``.

    Otherwise a result file would get the descriptor, and C libraries would print into it.
    """
    # in the order of the descriptors, as the lowest free descriptor is opened
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115


# ---- arguments


def parsed(words: list[str]) -> argparse.Namespace:
    """Return the parsed arguments of a command line with PETSc options. Raises InputError."""
    ours, petsc = split_petsc_options(words)
    _refuse_one_dash(ours, petsc)
    args, unknown = command_parser().parse_known_args(
        ours, argparse.Namespace(petsc_options=shlex.join(petsc))
    )
    if unknown:
        near = did_you_mean(unknown[0], option_names(args.command))
        raise InputError(f"{args.command}: unknown argument {unknown[0]}{near}")
    return args


def split_petsc_options(words: list[str]) -> tuple[list[str], list[str]]:
    """Return the words of msmpetsc, and the words of PETSc options, which may have a value."""
    ours: list[str] = []
    petsc: list[str] = []
    for before, word in pairwise(["", *words]):
        is_ours = word.startswith("--") or word in OUR_SHORT or word.endswith(".toml")
        is_value = _is_petsc_option(before) and not is_ours
        (petsc if is_value or _is_petsc_option(word) else ours).append(word)
    return ours, petsc


def _is_petsc_option(word: str) -> bool:
    """Return whether a word is a PETSc option: a single dash and a letter."""
    return len(word) > 1 and word[0] == "-" and word[1].isalpha() and word not in OUR_SHORT


def _refuse_one_dash(ours: list[str], petsc: list[str]) -> None:
    """Raise InputError for our options with one dash, and for PETSc options outside ``run``."""
    name = ours[0] if ours else ""
    # argparse handles -h and a missing command
    if name not in COMMANDS:
        return
    valid = option_names(name)
    for word in petsc:
        doubled = f"-{word.partition('=')[0]}"
        # PETSc also has a -help
        is_petsc_help = name == "run" and doubled == "--help"
        if doubled in valid and not is_petsc_help:
            raise InputError(f"{word}: options of one dash are PETSc's, did you mean {doubled!r}?")
    if petsc and name != "run":
        raise InputError(
            f"{petsc[0]}: {name} takes no PETSc options{did_you_mean(f'-{petsc[0]}', valid)}"
        )


class Parser(argparse.ArgumentParser):
    """An argument parser that prints on rank 0 only and raises InputError."""

    def error(self, message: str) -> NoReturn:
        raise InputError(re.sub(r"^argument (\S+): (?=must )", r"\1 ", message))

    # argparse prints help and version by this method
    def _print_message(self, message: str, file: Any = None) -> None:
        if world().rank == 0:
            super()._print_message(message, file)


def versions_line() -> str:
    """Return the versions of msmpetsc, PETSc, MPI and Python, "no PETSc" if it cannot be loaded."""
    petsc = "no PETSc"
    mpi = "no MPI"
    # a missing or incompatible library may raise any exception
    with suppress(Exception):
        from petsc4py import PETSc

        petsc = f"PETSc {'.'.join(map(str, PETSc.Sys.getVersion()))}"
    with suppress(Exception):
        from mpi4py import MPI

        # for example "Open MPI v5.0.7"
        mpi = re.split(r"[,\n\0]", MPI.Get_library_version())[0].strip()
    return f"msmpetsc {msmpetsc.__version__} ({petsc}, {mpi}, Python {platform.python_version()})"


def command_parser() -> Parser:
    """Return the parser of all commands."""
    parser = Parser(prog="msmpetsc", description=msmpetsc.__doc__)
    about = "show the versions of msmpetsc, PETSc and MPI"
    parser.add_argument("--version", action=Shown, const=versions_line, help=about)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        examples = "\n  ".join(("examples:", *command.examples))
        about = textwrap.fill(command.description or "")
        add = commands.add_parser(
            name,
            help=command.help,
            description=about,
            epilog=examples,
            formatter_class=RawDescriptionHelpFormatter,
        )
        for names, keywords in command.arguments:
            add.add_argument(*names, **keywords)
        group = add.add_mutually_exclusive_group()
        for names, keywords in VERBOSITY:
            group.add_argument(*names, **keywords)
    return parser


def option_names(command: str) -> list[str]:
    """Return the names of a command's options, for example "--preset"."""
    given = (*COMMANDS[command].arguments, *VERBOSITY)
    return ["--help", *(name for names, _ in given for name in names if name.startswith("-"))]


if __name__ == "__main__":
    entry_point()
