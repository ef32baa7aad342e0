"""Checks of the paths that a user gives, before anything is read or written."""

import os
import unicodedata
from pathlib import Path

from msmpetsc.errors import InputError, printable
from msmpetsc.results.disk import refuse_no_file

RESULT_NAMES, PICTURE_NAMES, MEASURE_NAMES = (".h5", ".hdf5"), (".png",), (".json",)
MOVIE_NAMES, PAGE_NAMES = (".mp4", ".gif", ".webp"), (".html",)
SCENE_NAMES = (".toml",)
# Unicode categories of control characters, surrogates (no UTF-8) and line separators
UNPRINTABLE = ("Cc", "Cs", "Zl", "Zp")


def checked_path(given: str | os.PathLike[str]) -> Path:
    """Return a path that is printable and exists or may be created. Raises InputError."""
    text = os.fspath(given)
    if not text:
        raise InputError("the path is empty")
    if any(unicodedata.category(letter) in UNPRINTABLE for letter in text):
        raise InputError(f"{printable(text, 60)!r} has control characters, or is not UTF-8 text")
    try:
        os.stat(text)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        raise InputError(f"{printable(text, 60)}: {error.strerror}") from None
    return Path(text)


def checked_file(given: str | os.PathLike[str]) -> Path:
    """Return the path of a file. Raises InputError for a folder, a pipe or a device."""
    path = checked_path(given)
    if path.name in ("", "..") or os.fspath(given).endswith("/"):
        raise InputError(f"{given} is a folder, not a file")
    refuse_no_file(path)
    return path


def refuse_other_format(
    option: str, path: str | os.PathLike[str] | None, endings: tuple[str, ...]
) -> None:
    """Raise InputError for a file name that has none of the ``endings``."""
    if path is not None and Path(path).suffix.lower() not in endings:
        names = " or ".join(f"*{ending}" for ending in endings)
        raise InputError(f"{option} {path}: the file must be named {names}")
