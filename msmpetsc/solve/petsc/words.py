"""PETSc's options as words: taken apart, judged where they come from a file, and lent to a PETSc that runs already."""

import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from msmpetsc.errors import InputError, printable

if TYPE_CHECKING:  # a study reads words, and needs no MPI for that
    from mpi4py import MPI

NAME = re.compile(r"-[A-Za-z]")
SOLVER_OPTION = re.compile(r"-(npc_|inner_|sub_|mg_\w*|esteig_)?(snes|ksp|pc|mat|mg|sub)_\w+")
PLAIN_VALUE = re.compile(r"([-+]?\.?\d|[^\W\d])[\w.,+-]*")  # no path, no file:name, no module:class
MORE_THAN_SOLVING = re.compile(r"^-\w*_(python|view|monitor|dump|load|file|filename|reason|plot|tmpdir|prefix)(_|$)")
READ_BY_OBJECTS = re.compile(r"(^|_)(snes|ksp|pc|mat|vec|mg|sub|eps|st)_")  # whenever one is made


def unsafe_word(words: Sequence[str]) -> str | None:
    """Return the first of PETSc's options and their values that a file may not hold, if any.

    A file may choose solvers; it may not make PETSc, or us, run code, read files or write them.
    """
    for word in words:
        known = SOLVER_OPTION.fullmatch(word) or PLAIN_VALUE.fullmatch(word)
        if not known or word == "python" or MORE_THAN_SOLVING.search(word):
            return word
    return None


def options_of(words: Sequence[str]) -> dict[str, str]:
    """Return the options as PETSc's database has them: names without a dash, "" where there is no value."""
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
    """Return options given in Python as words: "-ksp_rtol 1e-3 -ksp_view", or {"ksp_rtol": 1e-3, "ksp_view": None}.

    Raises InputError for what is no option.
    """
    try:
        words = shlex.split(options) if isinstance(options, str) else _words_of_mapping(options)
    except ValueError as error:
        raise InputError(f"PETSc options {printable(str(options), 60)!r}: {str(error).lower()}") from None
    if words and not NAME.match(words[0]):
        raise InputError(f"PETSc options begin with a dash and a letter, not {printable(words[0], 60)!r}")
    return words


def _words_of_mapping(options: Mapping[str, Any]) -> list[str]:
    words = []
    for name, value in options.items():
        option = f"-{name.removeprefix('-')}"
        if not re.fullmatch(r"-[A-Za-z]\w*", option):
            raise ValueError(f"{option} is no name of an option")
        text = "false" if value is False else str(value)
        words += [option] if value is None or value is True else [option, text]
    return words


def is_running() -> bool:
    """Return whether this process has started PETSc."""
    module = sys.modules.get("petsc4py.PETSc")
    return module is not None and module.Sys.isInitialized() and not module.Sys.isFinalized()


def start_for_runs(comm: "MPI.Comm", words: Sequence[str]) -> None:
    """Start PETSc, if it does not run, with those of the options that it reads only then (collective).

    The others are for ``lent_options``, which takes them back.
    """
    from msmpetsc.solve.petsc.initialise import initialise

    if not is_running():
        at_start = [(name, value) for name, value in options_of(words).items() if not READ_BY_OBJECTS.search(name)]
        initialise(comm, [word for name, value in at_start for word in (f"-{name}", value) if word])


@contextmanager
def lent_options(comm: "MPI.Comm", words: Sequence[str]) -> Iterator[None]:
    """Start PETSc with these options; if it runs already, lend it them for the time of the block (collective).

    Raises InputError for options that a PETSc that runs would not read any more.
    """
    from msmpetsc.solve.petsc.initialise import initialise

    if not is_running():
        initialise(comm, list(words))
        yield
        return
    from petsc4py import PETSc

    database = PETSc.Options()
    before, options = database.getAll(), options_of(words)
    for name, value in options.items():
        if not READ_BY_OBJECTS.search(name) and (name not in before or (before[name] or "") != value):
            raise InputError(f"-{name}: PETSc runs already, and reads this at its start only: give it to the first run")
    try:
        for name, value in options.items():
            database.setValue(name, value or None)
        yield
    finally:
        for name in database.getAll().keys() - before.keys():
            database.delValue(name)
        for name, value in before.items():
            database.setValue(name, value or None)
