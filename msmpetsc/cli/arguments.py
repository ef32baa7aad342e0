"""What several commands ask of their arguments."""

import argparse
import os
import unicodedata
from pathlib import Path

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
