"""The entry point of the command line: it parses, carries out, and reports failures in one line and an exit status.

What is imported at the top starts neither MPI nor PETSc, so that ``--help`` answers at once.
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
from typing import Any, NoReturn

import msmpetsc
from msmpetsc.app.checks import SCENE_NAMES
from msmpetsc.app.ending import STATUS_BUG, STATUS_INTERRUPTED, ending_together, logged_on_root
from msmpetsc.app.ranks import world
from msmpetsc.cli.command_table import COMMANDS, SAID, Shown
from msmpetsc.errors import InputError, MsmpetscError, did_you_mean, printable

READING = ("render", "export", "compare", "series")  # the extra "render" is enough for these
OUR_SHORT = ("-o", "-h")


def main(arguments: list[str] | None = None) -> int:
    """Run one command; return 0, 2 for bad input, 3 for a step that failed (collective)."""
    words = sys.argv[1:] if arguments is None else arguments
    args = argparse.Namespace(verbose=False)
    comm = world()
    try:
        with ending_together(comm):
            args = parsed(words)  # --help and --version leave from here
            comm = world(started=args.command == "run")  # the other commands are for one process
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
    """Run the installed ``msmpetsc``.

    It ends quietly, as other programs do, when who reads what it prints goes away: ``msmpetsc doctor | head -1``.
    """
    try:
        try:
            status = main()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (
            sys.stdout,
            sys.stderr,
        ):  # what is left to be written, at the exit too, has no reader
            os.dup2(nowhere, stream.fileno())
        status = 128 + signal.SIGPIPE
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # all is done: one more could only spoil the status
    sys.exit(status)


# ---- arguments


def parsed(words: list[str]) -> argparse.Namespace:
    """Parse a whole command line: our own arguments, and PETSc's options. Raises InputError."""
    ours, petsc = split_petsc_options(words)
    if ours and ours[0] not in COMMANDS and not ours[0].startswith("-"):
        word = printable(ours[0], 60)
        if word.endswith(SCENE_NAMES):
            raise InputError(
                f"{word} is no command, did you mean 'msmpetsc run {shlex.quote(word)}'?"
            )
        raise InputError(
            f"{word} is no command{did_you_mean(word, COMMANDS) or ': ' + ', '.join(COMMANDS)}"
        )
    _refuse_one_dash(ours, petsc)
    args, unknown = command_parser().parse_known_args(
        ours, argparse.Namespace(petsc_options=shlex.join(petsc))
    )
    if unknown:
        near = did_you_mean(unknown[0], option_names(args.command))
        raise InputError(f"{args.command}: unknown argument {unknown[0]}{near}")
    return args


def split_petsc_options(words: list[str]) -> tuple[list[str], list[str]]:
    """Split words into ours and PETSc's options, which have one dash and may have a value."""
    ours: list[str] = []
    petsc: list[str] = []
    for before, word in pairwise(["", *words]):
        ends_it = word.startswith("--") or word in OUR_SHORT or word.endswith(".toml")
        value = _is_petsc_option(before) and not ends_it
        (petsc if value or _is_petsc_option(word) else ours).append(word)
    return ours, petsc


def _is_petsc_option(word: str) -> bool:
    return len(word) > 1 and word[0] == "-" and word[1].isalpha() and word not in OUR_SHORT


def _refuse_one_dash(ours: list[str], petsc: list[str]) -> None:
    """Raise InputError for our options with one dash, and PETSc options where none are taken."""
    name = ours[0] if ours else ""
    if name not in COMMANDS:  # -h, or nothing at all, of which argparse says so
        return
    valid = option_names(name)
    for word in petsc:
        doubled = f"-{word.partition('=')[0]}"
        if doubled in valid and not (
            name == "run" and doubled == "--help"
        ):  # PETSc has a -help, too
            raise InputError(f"{word}: options of one dash are PETSc's, did you mean {doubled!r}?")
    if petsc and name != "run":
        raise InputError(
            f"{petsc[0]}: {name} takes no PETSc options{did_you_mean(f'-{petsc[0]}', valid)}"
        )


class Parser(argparse.ArgumentParser):
    """A parser that prints on rank 0 only, and raises InputError."""

    def error(self, message: str) -> NoReturn:
        raise InputError(re.sub(r"^argument (\S+): (?=must )", r"\1 ", message))

    def _print_message(
        self, message: str, file: Any = None
    ) -> None:  # where argparse prints help and version
        if world().rank == 0:
            super()._print_message(message, file)


def versions_line() -> str:
    """Return the versions of this package, PETSc, MPI and Python; what cannot be loaded says so."""
    petsc = "no PETSc"
    mpi = "no MPI"
    with suppress(Exception):  # it is missing, or built for another: each in its own way
        from petsc4py import PETSc

        petsc = f"PETSc {'.'.join(map(str, PETSc.Sys.getVersion()))}"
    with suppress(Exception):
        from mpi4py import MPI

        mpi = re.split(r"[,\n\0]", MPI.Get_library_version())[0].strip()  # "Open MPI v5.0.7"
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
        for choice in filter(None, (command.exclusive, SAID)):
            group = add.add_mutually_exclusive_group()
            for names, keywords in choice:
                group.add_argument(*names, **keywords)
    return parser


def option_names(command: str) -> list[str]:
    """Return the options of a command, such as "--preset"."""
    known = COMMANDS[command]
    given = (*known.arguments, *known.exclusive, *SAID)
    return ["--help", *(name for names, _ in given for name in names if name.startswith("-"))]


if __name__ == "__main__":
    entry_point()
