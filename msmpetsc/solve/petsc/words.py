"""PETSc options as words: parsing, and safety checks of options from files."""

import re
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from msmpetsc.errors import InputError, printable

NAME = re.compile(r"-[A-Za-z]")
SOLVER_OPTION = re.compile(r"-(npc_|inner_|sub_|mg_\w*|esteig_)?(snes|ksp|pc|mat|mg|sub)_\w+")
# values that are no path, no file:name and no module:class
PLAIN_VALUE = re.compile(r"([-+]?\.?\d|[^\W\d])[\w.,+-]*")
# options that read or write files or run code
MORE_THAN_SOLVING = re.compile(
    r"^-\w*_(python|view|monitor|dump|load|file|filename|reason|plot|tmpdir|prefix)(_|$)"
)


def unsafe_word(words: Sequence[str]) -> str | None:
    """Return the first option or value that a file must not contain; None if all are safe.

    A file may choose solvers. It must not make the program run code, read files or write files.
    """
    for word in words:
        known = SOLVER_OPTION.fullmatch(word) or PLAIN_VALUE.fullmatch(word)
        if not known or word == "python" or MORE_THAN_SOLVING.search(word):
            return word
    return None


def options_of(words: Sequence[str]) -> dict[str, str]:
    """Return words as a table of options: name without dash -> value; "" without a value."""
    options: dict[str, str] = {}
    name = None
    for word in words:
        if NAME.match(word):
            name = word[1:]
            options[name] = ""
        elif name:
            options[name] = word
    return options


def words_of(options: str | Mapping[str, Any]) -> list[str]:
    """Return options given in Python as a list of words.

    Raises InputError for text that is no option.

    options : "-ksp_rtol 1e-3 -ksp_view" or {"ksp_rtol": 1e-3, "ksp_view": None}
    """
    try:
        words = shlex.split(options) if isinstance(options, str) else _words_of_mapping(options)
    except ValueError as error:
        raise InputError(
            f"PETSc options {printable(str(options), 60)!r}: {str(error).lower()}"
        ) from None
    if words and not NAME.match(words[0]):
        raise InputError(
            f"PETSc options begin with a dash and a letter, not {printable(words[0], 60)!r}"
        )
    return words


def _words_of_mapping(options: Mapping[str, Any]) -> list[str]:
    """Return a table of options as words. Raises ValueError for a malformed name."""
    words = []
    for name, value in options.items():
        option = f"-{name.removeprefix('-')}"
        if not re.fullmatch(r"-[A-Za-z]\w*", option):
            raise ValueError(f"{option} is no name of an option")
        text = "false" if value is False else str(value)
        words += [option] if value is None or value is True else [option, text]
    return words
