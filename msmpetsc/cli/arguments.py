"""What several commands ask of their arguments."""

import argparse
import os
import unicodedata
from pathlib import Path

from mpi4py import MPI

from msmpetsc.errors import InputError, printable

NO_PART_OF_A_LINE = ("Cc", "Cs", "Zl", "Zp")  # categories: controls, bytes that are no UTF-8, ends of lines


def path_argument(text: str) -> Path:
    """Of an argument: a path that can be told in one line, to what is there or may be made there."""
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
    """The same of a file: no folder, pipe or device."""
    found = path_argument(text)
    if found.is_dir() or found.name in ("", "..") or text.endswith("/"):
        raise argparse.ArgumentTypeError(f"{text} is a folder, not a file")
    if found.exists() and not found.is_file():
        raise argparse.ArgumentTypeError(f"{text} is a pipe or a device, not a file")
    return found


def refuse_below_one(args: argparse.Namespace, *names: str) -> None:
    """Raises InputError for the first of these that is given and below 1."""
    for name in names:
        number = getattr(args, name)
        if number is not None and number < 1:
            raise InputError(f"--{name.replace('_', '-')} must be at least 1, not {number}")


RESULT_NAMES, PICTURE_NAMES, MEASURE_NAMES = (".h5", ".hdf5"), (".png",), (".json",)
NO_FOLDERS = (*RESULT_NAMES, *PICTURE_NAMES, *MEASURE_NAMES) + (
    ".csv", ".gif", ".html", ".jpeg", ".jpg", ".pdf", ".svg", ".toml", ".txt", ".vtk", ".vtu", ".xdmf", ".zip"
)  # fmt: skip


def refuse_other_format(option: str, path: Path | None, endings: tuple[str, ...]) -> None:
    """Raises InputError for the name of a file of another format than is written."""
    if path is not None and path.suffix.lower() not in endings:
        raise InputError(f"{option} {path}: what is written there is named {' or '.join(f'*{end}' for end in endings)}")


def refuse_name_of_a_file(option: str, folder: Path | None) -> None:
    """Raises InputError for a folder that is to be made under the name of a file."""
    if folder is not None and folder.suffix.lower() in NO_FOLDERS and not folder.is_dir():
        raise InputError(f"{option} {folder}: what is written there is a folder, no {folder.suffix} file")


def refuse_ranks(command: str, why: str) -> None:
    """Raises InputError where mpiexec has started more than one of a command that is for one process alone."""
    if MPI.COMM_WORLD.size > 1:
        raise InputError(f"{command} is started without mpiexec: {why}")
