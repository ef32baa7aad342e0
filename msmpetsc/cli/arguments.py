"""The command line parsed, and what several commands refuse of it; options/ has the arguments of each command.

What is imported at the top starts neither MPI nor PETSc, so that ``--help`` answers at once.
"""

import argparse
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import msmpetsc
from msmpetsc.cli.options.checks import add_check
from msmpetsc.cli.options.examples import EXAMPLES, EXAMPLES_HEAD, ExamplesKept
from msmpetsc.cli.options.planning import add_inspect, add_plan, add_study
from msmpetsc.cli.options.program import add_completion, add_doctor
from msmpetsc.cli.options.results import add_compare, add_export, add_render
from msmpetsc.cli.options.run import add_run
from msmpetsc.cli.options.scenes import add_fetch, add_keys, add_new, add_schema
from msmpetsc.cli.options.values import Commands, add_verbosity
from msmpetsc.cli.ranks import world
from msmpetsc.errors import InputError, did_you_mean, printable

OUR_SHORT = ("-o", "-h")
TAKE_PETSC_OPTIONS = ("run",)

# Parsing


def parsed(words: list[str]) -> argparse.Namespace:
    """Parse a whole command line. Raises InputError."""
    return parsed_apart(*split_petsc_options(words), words)


def parsed_apart(ours: list[str], petsc: list[str], words: list[str]) -> argparse.Namespace:
    """Parse our own arguments and PETSc's options.

    ours  : the command, then its arguments
    petsc : PETSc's options, each of them followed by its value if it has one
    words : all of them as they are to be recorded

    Raises InputError.
    """
    _refuse_unknown_command(ours)
    _refuse_one_dash(ours, petsc)
    given = argparse.Namespace(petsc_options=tuple(petsc), words=tuple(words))
    args, unknown = command_parser().parse_known_args(ours, given)
    if unknown:
        near = did_you_mean(unknown[0], option_names(args.command))
        raise InputError(f"{args.command}: unknown argument {unknown[0]}{near}")
    if petsc and args.command not in TAKE_PETSC_OPTIONS:
        raise InputError(f"{petsc[0]}: {args.command} takes no PETSc options")
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
    "new": add_new,
    "run": add_run,
    "inspect": add_inspect,
    "study": add_study,
    "plan": add_plan,
    "compare": add_compare,
    "render": add_render,
    "export": add_export,
    "check": add_check,
    "fetch": add_fetch,
    "keys": add_keys,
    "schema": add_schema,
    "doctor": add_doctor,
    "completion": add_completion,
}


# What several commands refuse

RUNS_ITSELF = "it starts its runs on as many ranks as they need"
RESULT_NAMES, PICTURE_NAMES, MEASURE_NAMES = (".h5", ".hdf5"), (".png",), (".json",)
MOVIE_NAMES, PAGE_NAMES = (".mp4", ".gif", ".webp"), (".html",)
SCENE_NAMES, XML_NAMES = (".toml",), (".xml",)
NO_FOLDERS = (
    *RESULT_NAMES, *PICTURE_NAMES, *MEASURE_NAMES, *MOVIE_NAMES, *PAGE_NAMES,
    ".csv", ".jpeg", ".jpg", ".pdf", ".svg", ".toml", ".txt", ".vtk", ".vtu", ".xdmf", ".zip"
)  # fmt: skip


def refuse_below_one(**numbers: int | None) -> None:
    """Raise InputError for the first option that is given and below 1: ``true_error=0`` for ``--true-error 0``."""
    for name, number in numbers.items():
        if number is not None and number < 1:
            raise InputError(f"--{name.replace('_', '-')} must be at least 1, not {number}")


def refuse_other_format(option: str, path: Path | None, endings: tuple[str, ...]) -> None:
    """Raise InputError for the name of a file of another format than is written."""
    if path is not None and path.suffix.lower() not in endings:
        raise InputError(f"{option} {path}: what is written there is named {' or '.join(f'*{end}' for end in endings)}")


def refuse_name_of_a_file(option: str, folder: Path | None) -> None:
    """Raise InputError for a folder that is to be made under the name of a file."""
    if folder is not None and folder.suffix.lower() in NO_FOLDERS and not folder.is_dir():
        raise InputError(f"{option} {folder}: what is written there is a folder, no {folder.suffix} file")


def refuse_ranks(command: str, why: str) -> None:
    """Raise InputError where mpiexec has started more than one of a command that is for one process alone."""
    if world().size > 1:
        raise InputError(f"{command} is started without mpiexec: {why}")


def interrupt(*_: Any) -> None:
    """Treat a signal to end as Ctrl-C: the runs under way end with this process."""
    raise KeyboardInterrupt
