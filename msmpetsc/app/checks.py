"""What is refused of paths and numbers that a user gives, before anything is done with them."""

import os
import unicodedata
from pathlib import Path

from msmpetsc.errors import InputError, printable
from msmpetsc.results.disk import refuse_no_file

RESULT_NAMES, PICTURE_NAMES, MEASURE_NAMES = (".h5", ".hdf5"), (".png",), (".json",)
MOVIE_NAMES, PAGE_NAMES = (".mp4", ".gif", ".webp"), (".html",)
SCENE_NAMES = (".toml",)
NO_PART_OF_A_LINE = (
    "Cc",
    "Cs",
    "Zl",
    "Zp",
)  # categories: controls, bytes that are no UTF-8, ends of lines


def checked_path(given: str | os.PathLike[str]) -> Path:
    """Return a path that prints as one line, and exists or may be created. Raises InputError."""
    text = os.fspath(given)
    if not text:
        raise InputError("an empty path leads nowhere")
    if any(unicodedata.category(letter) in NO_PART_OF_A_LINE for letter in text):
        raise InputError(f"{printable(text, 60)!r} has control characters, or is not UTF-8 text")
    try:
        os.stat(text)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        raise InputError(f"{printable(text, 60)}: {error.strerror}") from None
    return Path(text)


def checked_file(given: str | os.PathLike[str]) -> Path:
    """Return the path of a file: no folder, pipe or device. Raises InputError."""
    path = checked_path(given)
    if path.name in ("", "..") or os.fspath(given).endswith("/"):
        raise InputError(f"{given} is a folder, not a file")
    refuse_no_file(path)
    return path


def refuse_other_format(
    option: str, path: str | os.PathLike[str] | None, endings: tuple[str, ...]
) -> None:
    """Raise InputError for the name of a file of another format than is written."""
    if path is not None and Path(path).suffix.lower() not in endings:
        raise InputError(
            f"{option} {path}: what is written there is named {' or '.join(f'*{end}' for end in endings)}"
        )
