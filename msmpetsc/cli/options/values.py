"""What the arguments of several commands share: types of their values, ``--set``, and how much is said."""

import argparse
import os
import unicodedata
from pathlib import Path

from msmpetsc.errors import printable

Commands = argparse._SubParsersAction  # argparse has no public name for what add_subparsers returns
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


def add_set(parser: argparse.ArgumentParser) -> None:
    """Add ``--set``, which changes a scene."""
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="override a scene key: cages.count=3000"
    )


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``, for programs that read what a command prints."""
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")


def add_verbosity(parser: argparse.ArgumentParser) -> None:
    """Add ``--quiet`` and ``--verbose``, which every command has."""
    said = parser.add_mutually_exclusive_group()
    said.add_argument("--quiet", action="store_true", help="no notes and no progress; warnings and errors stay")
    said.add_argument("--verbose", action="store_true", help="notes with the time [s]; of an error where it arose, too")
