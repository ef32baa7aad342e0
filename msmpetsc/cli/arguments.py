"""The arguments of every command: how they are parsed, and what several commands refuse of them.

What is imported at the top starts neither MPI nor PETSc, so that ``--help`` answers at once.
"""

import argparse
import os
import sys
import unicodedata
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import msmpetsc
from msmpetsc.errors import InputError, did_you_mean, printable

OUR_SHORT = ("-o", "-h")
TAKE_PETSC_OPTIONS = ("run", "inspect")
LAUNCHED = {  # variables that Open MPI, MPICH, PMIx, Slurm, Flux and the launchers of Cray and IBM set for each rank
    "OMPI_COMM_WORLD_RANK", "PMI_RANK", "PMIX_RANK", "SLURM_PROCID", "FLUX_TASK_RANK", "ALPS_APP_PE", "PALS_RANKID",
    "JSM_NAMESPACE_RANK", "MPI_LOCALRANKID", "MV2_COMM_WORLD_RANK",
}  # fmt: skip

Commands = argparse._SubParsersAction  # argparse has no public name for what add_subparsers returns


def on_first_rank() -> bool:
    """Return whether this process is rank 0. MPI is started to say so only where a launcher started the process."""
    if not LAUNCHED & os.environ.keys():
        return True
    from mpi4py import MPI  # 0.3 s, which help need not wait for

    return MPI.COMM_WORLD.rank == 0


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


def _refuse_one_dash(ours: list[str], petsc: list[str]) -> None:
    """Raise InputError for options of ours that lack a dash, and for any of PETSc's where there is no use for them."""
    name = ours[0] if ours else ""
    if name not in COMMANDS:  # argparse says so
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
        if on_first_rank():
            super()._print_message(message, file)


def command_parser() -> Parser:
    """Make the parser of the whole program."""
    parser = Parser(prog="msmpetsc", description=msmpetsc.__doc__)
    parser.add_argument("--version", action="version", version=f"msmpetsc {msmpetsc.__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for add in COMMANDS.values():
        add(commands)
    return parser


def option_names(command: str) -> list[str]:
    """List the options of a command: "--preset"."""
    commands = Parser().add_subparsers()
    COMMANDS[command](commands)
    return list(commands.choices[command]._option_string_actions)


# Types of arguments

NO_PART_OF_A_LINE = ("Cc", "Cs", "Zl", "Zp")  # categories: controls, bytes that are no UTF-8, ends of lines


def path_argument(text: str) -> Path:
    """Return the path that an argument names: it prints as one line, and exists or may be created."""
    if not text:
        raise argparse.ArgumentTypeError("an empty path leads nowhere")
    if any(unicodedata.category(letter) in NO_PART_OF_A_LINE for letter in text):
        raise argparse.ArgumentTypeError(f"{printable(text, 60)!r} has control characters, or is not UTF-8 text")
    try:
        os.stat(text)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        raise argparse.ArgumentTypeError(f"{printable(text, 60)}: {error.strerror}") from None
    return Path(text)


def file_argument(text: str) -> Path:
    """Return the path of a file that an argument names: no folder, pipe or device."""
    path = path_argument(text)
    if path.is_dir() or path.name in ("", "..") or text.endswith("/"):
        raise argparse.ArgumentTypeError(f"{text} is a folder, not a file")
    if path.exists() and not path.is_file():
        raise argparse.ArgumentTypeError(f"{text} is a pipe or a device, not a file")
    return path


class ListPresets(argparse.Action):
    """Print the presets and leave."""

    def __init__(self, option_strings: list[str], dest: str, help: str):
        super().__init__(option_strings, dest, nargs=0, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from msmpetsc.solve.presets import PRESETS

        width = max(map(len, PRESETS))
        lines = [f"{name:{width}} {preset.about}\n" for name, preset in PRESETS.items()]
        parser._print_message("".join(lines), sys.stdout)
        parser.exit()


# The arguments of each command


def add_run(commands: Commands) -> None:
    """Add ``msmpetsc run``."""
    parser = commands.add_parser(
        "run",
        help="simulate a scene",
        description="Simulate a scene and write OUT.h5 and OUT.xdmf. PETSc options (one dash) may follow.",
    )
    parser.add_argument("scene", type=path_argument, nargs="?", metavar="SCENE", help="scene file (TOML)")
    parser.add_argument("-o", "--output", type=file_argument, metavar="OUT.h5", help="default: out/SCENE.h5")
    add_method(parser)
    add_output(parser)
    add_measuring(parser)


def add_method(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``run`` that choose what is computed, and how."""
    parser.add_argument("--preset", metavar="NAME", help="solver preset (see --list-presets)")
    parser.add_argument("--error", metavar="E", help="relative error at which a step is done")
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), help="where to compute: cuda is -mat_type aijcusparse, a CUDA GPU"
    )
    parser.add_argument("--frames", type=int, metavar="N", help="stop after N steps")
    add_set(parser)


def add_set(parser: argparse.ArgumentParser) -> None:
    """Add ``--set``, which changes a scene."""
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="override a scene key: cages.count=3000"
    )


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``run`` on its files."""
    parser.add_argument("--picture", action="store_true", help="also draw a few moments: OUT.png")
    parser.add_argument("--overwrite", action="store_true", help="replace OUT.h5 if it exists")
    parser.add_argument(
        "--resume", type=file_argument, metavar="OUT.h5",
        help="go on where the run that wrote this file was stopped; with SCENE, start it if there is no such file yet",
    )  # fmt: skip
    parser.add_argument("--force", action="store_true", help="resume with another scene or other options than before")
    parser.add_argument(
        "--checkpoint-every", metavar="N", help="frames, or 30s, 5min, 2h; default: as takes 1%% of the time at most"
    )
    parser.add_argument(
        "--gather",
        action="store_true",
        help="let rank 0 write for all: where nodes of a cluster do not see one file alike",
    )
    parser.add_argument("--compress", action="store_true", help="pack the finished OUT.h5: smaller, slower to read")


def add_measuring(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``run`` that measure, or only say something."""
    parser.add_argument(
        "--true-error", type=int, metavar="N", help="also solve every N-th step to rounding, and store its true error"
    )
    parser.add_argument("--trace", type=int, metavar="K", help="follow the iterates of step K (needs --measure)")
    parser.add_argument(
        "--measure", type=file_argument, metavar="OUT.json", help="write what the run cost: times, memory"
    )
    parser.add_argument(
        "--show-options", action="store_true", help="say which PETSc options a preset sets, as an options file"
    )
    parser.add_argument("--list-presets", action=ListPresets, help="say what each preset is for")


def add_inspect(commands: Commands) -> None:
    """Add ``msmpetsc inspect``."""
    parser = commands.add_parser(
        "inspect",
        help="say what a scene would need on so many ranks",
        description="Count cells, nodes, springs, ghosts and messages of each rank, and expect memory and time of a "
        "frame from two short runs here, on coarser lattices. PETSc options (one dash) may follow.",
    )
    parser.add_argument("scene", type=path_argument, metavar="SCENE", help="scene file (TOML)")
    parser.add_argument("--ranks", type=int, default=1, metavar="R", help="MPI ranks (1)")
    add_set(parser)
    parser.add_argument("--frames", type=int, default=10, metavar="N", help="steps of the short runs (10)")
    parser.add_argument("--measure-here", action="store_true", help="make the short runs again")
    parser.add_argument("--no-times", action="store_true", help="make none: counts and limits only")
    parser.add_argument("--latency", type=float, default=2e-6, metavar="S", help="of a message [s] (2e-6)")
    parser.add_argument("--bandwidth", type=float, default=1e10, metavar="B", help="of a rank [byte/s] (1e10)")


def add_study(commands: Commands) -> None:
    """Add ``msmpetsc study``."""
    parser = commands.add_parser(
        "study",
        help="sweep methods over scenes",
        description="Run the cases of a study, each in its own process, into a table and a report. "
        "Stopped, the same command goes on.",
    )
    parser.add_argument("study", type=path_argument, metavar="FILE.toml", help="study file")
    parser.add_argument("-o", "--output", type=path_argument, metavar="FOLDER", help="default: out/FILE")
    parser.add_argument("--full", action="store_true", help="also what is marked full = true: the long cases")
    parser.add_argument("--jobs", type=int, metavar="N", help="cases at a time (they slow each other)")
    parser.add_argument("--restart", action="store_true", help="forget the cases that are done")
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--part", metavar="I/N", help="only the I-th of N parts, for another machine or array task")
    only.add_argument("--list", action="store_true", help="only say which cases there are, and which are done")


def add_plan(commands: Commands) -> None:
    """Add ``msmpetsc plan``."""
    parser = commands.add_parser(
        "plan",
        help="find the cheapest options that meet an error",
        description="Try integrators, time steps and presets, for a surface error lattices too, on the first frames "
        "of a scene, and say which is the cheapest that meets the error. Exit status 3: none does.",
    )
    parser.add_argument("scene", type=path_argument, metavar="SCENE", help="scene file (TOML)")
    goal = parser.add_mutually_exclusive_group(required=True)
    goal.add_argument("--error", type=float, metavar="E", help="relative error of the trajectory")
    goal.add_argument("--step-error", type=float, metavar="E", help="true relative error of a step")
    goal.add_argument(
        "--surface-error", type=float, metavar="E",
        help="error of the surface, of its largest displacement: cells, step and solver together",
    )  # fmt: skip
    parser.add_argument("--frames", type=int, default=20, metavar="N", help="of the scene's steps, the first N (20)")
    parser.add_argument("--ranks", type=int, default=1, metavar="R", help="MPI ranks of the trials")
    parser.add_argument("--write", action="store_true", help="put the answer into the scene file")
    parser.add_argument("--cells", type=int, metavar="N", help="of --surface-error: finest trial; the scene's count")
    parser.add_argument(
        "--chart", type=file_argument, metavar="OUT.png", help="of --surface-error: draw error over cost of all trials"
    )


def add_compare(commands: Commands) -> None:
    """Add ``msmpetsc compare``."""
    parser = commands.add_parser(
        "compare",
        help="say whether two results agree",
        description="Compare two results at the times that both have; of different lattices their surfaces alone. "
        "Exit status 0: they agree; 1: they differ; 2: they cannot be compared.",
    )
    parser.add_argument("first", metavar="A.h5", type=file_argument)
    parser.add_argument("second", metavar="B.h5", type=file_argument)
    parser.add_argument("--rtol", type=float, default=1e-6, metavar="E", help="relative error that still agrees (1e-6)")
    parser.add_argument(
        "--fields", metavar="NAME,...", help="of /frames; position, surface, the energies and momentum if not given"
    )
    parser.add_argument(
        "--shared", action="store_true", help="times that only one of them has do not count as different"
    )


def add_render(commands: Commands) -> None:
    """Add ``msmpetsc render``."""
    parser = commands.add_parser("render", help="draw some moments of a result side by side")
    parser.add_argument("result", metavar="OUT.h5", type=file_argument)
    parser.add_argument(
        "-o", "--output", metavar="PNG", type=file_argument, help="default: beside the result, ending in .png"
    )
    parser.add_argument("--frames", metavar="0,10,20", help="these frames, in this order")
    parser.add_argument(
        "--count", metavar="N", type=int, help="choose this many moments (default: the scene's picture.times, or 5)"
    )
    parser.add_argument("--eye", metavar="X,Y,Z", help="direction from the body to the eye (--eye=-1,2,0.5)")


def add_fetch(commands: Commands) -> None:
    """Add ``msmpetsc fetch``."""
    parser = commands.add_parser("fetch", help="download named meshes, or list them")
    parser.add_argument("names", nargs="*", metavar="NAME", help="a model, see --list")
    parser.add_argument("--list", action="store_true", help="list the models and where they lie")


COMMANDS: dict[str, Callable[[Commands], None]] = {  # each is run by the module of its name
    "run": add_run,
    "inspect": add_inspect,
    "study": add_study,
    "plan": add_plan,
    "compare": add_compare,
    "render": add_render,
    "fetch": add_fetch,
}


# What several commands refuse

RUNS_ITSELF = "it starts its runs on as many ranks as they need"
RESULT_NAMES, PICTURE_NAMES, MEASURE_NAMES = (".h5", ".hdf5"), (".png",), (".json",)
NO_FOLDERS = (
    *RESULT_NAMES, *PICTURE_NAMES, *MEASURE_NAMES,
    ".csv", ".gif", ".html", ".jpeg", ".jpg", ".pdf", ".svg", ".toml", ".txt", ".vtk", ".vtu", ".xdmf", ".zip"
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
    from mpi4py import MPI

    if MPI.COMM_WORLD.size > 1:
        raise InputError(f"{command} is started without mpiexec: {why}")


def interrupt(*_: Any) -> None:
    """Treat a signal to end as Ctrl-C: the runs under way end with this process."""
    raise KeyboardInterrupt
