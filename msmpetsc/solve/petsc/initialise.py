"""PETSc started with the user's options: those of no solver it mostly reads only then.

One that runs already is lent others for the time of a run.
"""

import atexit
import ctypes
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import petsc4py
from mpi4py import MPI

from msmpetsc.comm import on_root
from msmpetsc.errors import InputError, printable
from msmpetsc.solve.petsc.words import options_of

FILE_OPTIONS = ("-options_file", "-options_file_yaml")
NOT_HERE = {
    "-python": "PETSc would start a Python within this one",
    "-fp_trap": "numbers that are not finite are told by the step that meets them",
}
OPTION = re.compile(r"--?[A-Za-z]")
READ_BY_OBJECTS = re.compile(r"(^|_)(snes|ksp|pc|mat|vec|mg|sub|eps|st)_")  # whenever one is made
TOKEN = re.compile(r'"[^"]*"?|\S+')


def initialise(comm: MPI.Comm, words: list[str]) -> None:
    """Start PETSc (collective).

    words : options and values, as on the command line; those of PETSC_OPTIONS and of .petscrc are read as well

    Raises InputError for option files that cannot be read, and for values that PETSc refuses at its start.
    """
    on_root(comm, lambda: _check_words(words))  # rank 0 alone reads files: others would wait
    failed = None
    with _captured_stderr() as text:
        try:
            petsc4py.init(["msmpetsc", *words])
        except RuntimeError as error:  # PETSc.Error, which has no name before PETSc is there
            failed = error
    if failed is not None:
        told = text[0].partition("PETSC ERROR: See ")[0]  # before where to find help
        lines = re.findall(r"^\[\d+\]PETSC ERROR: (.+)$", told, re.MULTILINE) or [str(failed)]
        raise InputError(
            f"PETSc cannot start with its options: {printable(lines[-1].strip(), 200)}"
        )
    if text[0]:
        sys.stderr.write(text[0])


def _check_words(words: list[str]) -> None:
    """Raise InputError for options that end the process, and for the first option file that PETSc could not read."""
    words = [*os.environ.get("PETSC_OPTIONS", "").split(), *words, ""]
    for option, name in pairwise(words):
        if option in NOT_HERE:
            raise InputError(f"{option}: {NOT_HERE[option]}")
        if option not in FILE_OPTIONS:
            continue
        where = f"{option} {printable(name)}"
        if not name or OPTION.match(name):
            raise InputError(f"{option}: names no file")
        if not Path(name).is_file() or not os.access(name, os.R_OK):
            raise InputError(f"{where}: is no file that can be read")
        if option == FILE_OPTIONS[0]:
            _check_lines(where, Path(name).read_text(errors="replace").splitlines())


def _check_lines(where: str, lines: list[str]) -> None:
    """Raise InputError for a line that is no option, with or without a value, nor an alias."""
    for number, line in enumerate(lines, 1):
        tokens = TOKEN.findall(line.partition("#")[0])
        if tokens and tokens[0] in NOT_HERE:
            raise InputError(f"{where}: line {number}: {NOT_HERE[tokens[0]]}")
        value = tokens[1] if len(tokens) > 1 else ""
        is_alias = tokens[:1] == ["alias"] and len(tokens) == 3
        is_option = (
            len(tokens) <= 2
            and all(map(OPTION.match, tokens[:1]))
            and not re.match("-[A-Za-z]", value)
        )
        if not is_alias and not is_option:
            raise InputError(
                f"{where}: line {number} is no option with its value: {printable(line.strip(), 60)}"
            )


@contextmanager
def _captured_stderr() -> Iterator[list[str]]:
    """Capture what the C library prints in the block; the text is filled in after it."""
    text = [""]
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield text
        finally:
            ctypes.CDLL(None).fflush(None)
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            text[0] = file.read().decode(errors="replace")


def is_running() -> bool:
    """Return whether this process has started PETSc."""
    module = sys.modules.get("petsc4py.PETSc")
    return module is not None and module.Sys.isInitialized() and not module.Sys.isFinalized()


@atexit.register
def finalise() -> None:
    """End PETSc, if it runs, while Python still does (collective).

    PETSc destroys what Python's collector has left it: a PC of type python calls Python for that.
    """
    if is_running():
        sys.modules["petsc4py.PETSc"]._finalize()


def start_for_runs(comm: MPI.Comm, words: Sequence[str]) -> None:
    """Start PETSc, if it does not run, with those options that it reads only then (collective).

    The others are for ``lent_options``, which takes them back.
    """
    if not is_running():
        at_start = [
            (name, value)
            for name, value in options_of(words).items()
            if not READ_BY_OBJECTS.search(name)
        ]
        initialise(comm, [word for name, value in at_start for word in (f"-{name}", value) if word])


@contextmanager
def lent_options(comm: MPI.Comm, words: Sequence[str]) -> Iterator[None]:
    """Start PETSc with these options; if it runs already, lend it them for the time of the block (collective).

    Raises InputError for options that a PETSc that runs would not read any more.
    """
    if not is_running():
        initialise(comm, list(words))
        yield
        return
    from petsc4py import PETSc

    database = PETSc.Options()
    before, options = database.getAll(), options_of(words)
    for name, value in options.items():
        if not READ_BY_OBJECTS.search(name) and (
            name not in before or (before[name] or "") != value
        ):
            raise InputError(
                f"-{name}: PETSc runs already, and reads this at its start only: give it to the first run"
            )
    try:
        for name, value in options.items():
            database.setValue(name, value or None)
        yield
    finally:
        for name in database.getAll().keys() - before.keys():
            database.delValue(name)
        for name, value in before.items():
            database.setValue(name, value or None)
