"""The command line parsed; options.py has the arguments of each command.

What is imported at the top starts neither MPI nor PETSc, so that ``--help`` answers at once.
"""

import argparse
import shlex
import sys
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import msmpetsc
from msmpetsc.app.checks import SCENE_NAMES
from msmpetsc.cli import options
from msmpetsc.cli.options import EXAMPLES, EXAMPLES_HEAD, Commands, ExamplesKept, add_verbosity
from msmpetsc.cli.ranks import world
from msmpetsc.errors import InputError, did_you_mean, printable

OUR_SHORT = ("-o", "-h")
TAKE_PETSC_OPTIONS = ("run",)


def parsed(words: list[str]) -> argparse.Namespace:
    """Parse a whole command line: our own arguments, and PETSc's options. Raises InputError."""
    ours, petsc = split_petsc_options(words)
    _refuse_unknown_command(ours)
    _refuse_one_dash(ours, petsc)
    args, unknown = command_parser().parse_known_args(ours, argparse.Namespace(petsc_options=shlex.join(petsc)))
    if unknown:
        near = did_you_mean(unknown[0], option_names(args.command))
        raise InputError(f"{args.command}: unknown argument {unknown[0]}{near}")
    return args


def split_petsc_options(words: list[str]) -> tuple[list[str], list[str]]:
    """Split into ours and PETSc's: those of one dash, each with the value that follows it, as PETSc reads them."""
    ours: list[str] = []
    petsc: list[str] = []
    for before, word in pairwise(["", *words]):
        ends_it = word.startswith("--") or word in OUR_SHORT or word.endswith(".toml")
        value = _is_petsc_option(before) and not ends_it
        (petsc if value or _is_petsc_option(word) else ours).append(word)
    return ours, petsc


def _is_petsc_option(word: str) -> bool:
    return len(word) > 1 and word[0] == "-" and word[1].isalpha() and word not in OUR_SHORT


def _refuse_unknown_command(ours: list[str]) -> None:
    """Raise InputError for a word that is no command, with the one that may be meant."""
    if not ours or ours[0] in COMMANDS or ours[0].startswith("-"):
        return
    word = printable(ours[0], 60)
    if word.endswith(SCENE_NAMES):
        raise InputError(f"{word} is no command, did you mean 'msmpetsc run {word}'?")
    raise InputError(f"{word} is no command{did_you_mean(word, COMMANDS) or ': ' + ', '.join(COMMANDS)}")


def _refuse_one_dash(ours: list[str], petsc: list[str]) -> None:
    """Raise InputError for options of ours that lack a dash, and for any of PETSc's where there is no use for them."""
    name = ours[0] if ours else ""
    if name not in COMMANDS:  # -h, or nothing at all, of which argparse says so
        return
    valid = option_names(name)
    for word in petsc:
        doubled = f"-{word.partition('=')[0]}"
        if doubled in valid and not (name in TAKE_PETSC_OPTIONS and doubled == "--help"):  # PETSc has a -help, too
            raise InputError(f"{word}: options of one dash are PETSc's, did you mean {doubled!r}?")
    if petsc and name not in TAKE_PETSC_OPTIONS:
        raise InputError(f"{petsc[0]}: {name} takes no PETSc options{did_you_mean(f'-{petsc[0]}', valid)}")


class Parser(argparse.ArgumentParser):
    """A parser that prints on rank 0 only, and raises InputError."""

    def error(self, message: str):
        raise InputError(message)

    def _print_message(self, message: str, file: Any = None) -> None:  # where argparse prints help and version
        if world().rank == 0:
            super()._print_message(message, file)


class Version(argparse.Action):
    """Print the versions and leave; PETSc and MPI are loaded only here."""

    def __init__(self, option_strings: list[str], dest: str, help: str):
        super().__init__(option_strings, dest, nargs=0, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from msmpetsc.cli.versions import library_versions

        libraries = ", ".join(library_versions())
        parser._print_message(f"msmpetsc {msmpetsc.__version__} ({libraries})\n", sys.stdout)
        parser.exit()


def command_parser() -> Parser:
    """Make the parser of the whole program."""
    parser = Parser(prog="msmpetsc", description=msmpetsc.__doc__)
    parser.add_argument("--version", action=Version, help="show the versions of msmpetsc, PETSc and MPI")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        add_command(commands, name)
    return parser


def add_command(commands: Commands, name: str) -> Parser:
    """Add a command with its own arguments, with those that all have, and with its examples."""
    COMMANDS[name](commands)
    parser = commands.choices[name]
    add_verbosity(parser)
    parser.epilog, parser.formatter_class = "\n  ".join((EXAMPLES_HEAD, *EXAMPLES[name])), ExamplesKept
    return parser


def option_names(command: str) -> list[str]:
    """List the options of a command: "--preset"."""
    return list(add_command(Parser().add_subparsers(), command)._option_string_actions)


COMMANDS: dict[str, Callable[[Commands], None]] = {  # each is run by the module of its name
    "new": options.add_new,
    "run": options.add_run,
    "inspect": options.add_inspect,
    "study": options.add_study,
    "plan": options.add_plan,
    "compare": options.add_compare,
    "render": options.add_render,
    "export": options.add_export,
    "check": options.add_check,
    "fetch": options.add_fetch,
    "keys": options.add_keys,
    "schema": options.add_schema,
    "doctor": options.add_doctor,
    "completion": options.add_completion,
}
