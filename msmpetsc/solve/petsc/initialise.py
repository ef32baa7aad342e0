"""PETSc started with the user's options, once: it reads most of those that are not of a solver only then."""

import ctypes
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import petsc4py
from mpi4py import MPI

from msmpetsc.comm import on_root
from msmpetsc.errors import InputError, printable

FILE_OPTIONS = ("-options_file", "-options_file_yaml")
RC_FILES = (".petscrc", "petscrc")  # of the working folder; the first of the home folder, too
OPTION = re.compile(r"--?[A-Za-z]")
TOKEN = re.compile(r'"[^"]*"?|\S+')
MOST_NESTED = 20  # option files within each other


def initialise(comm: MPI.Comm, words: list[str]) -> None:
    """Start PETSc (collective).

    words : options and values, as on the command line; those of PETSC_OPTIONS and of .petscrc are read as well

    Raises InputError for option files that cannot be read, and for values that PETSc refuses at its start.
    """
    on_root(comm, lambda: _check_files(words))  # rank 0 alone reads them: the others would wait for it
    failed = None
    with _captured_stderr() as text:
        try:
            petsc4py.init(["msmpetsc", *words])
        except RuntimeError as error:  # PETSc.Error, which has no name before PETSc is there
            failed = error
    if failed is not None:
        raise InputError(f"PETSc cannot start with its options: {_message(text[0]) or failed}")
    if text[0]:
        sys.stderr.write(text[0])


def _check_files(words: list[str]) -> None:
    """Raise InputError for the first option file that PETSc could not read."""
    words = [*os.environ.get("PETSC_OPTIONS", "").split(), *words]
    if "-skip_petscrc" not in words:
        for path in [Path.home() / RC_FILES[0], *map(Path, RC_FILES)]:
            if path.is_file():
                _check_file(str(path), "", 0)
    for option, value in pairwise([*words, ""]):
        if option in FILE_OPTIONS:
            _check_file(value, option, 0)


def _check_file(name: str, option: str, depth: int) -> None:
    where = f"{option} {printable(name)}".strip()
    if not name or OPTION.match(name):
        raise InputError(f"{option}: names no file")
    path = Path(name)
    if path.exists() and not path.is_file():  # what a pipe holds can be read only once
        raise InputError(f"{where}: is a folder, a pipe or a device, not a file")
    try:
        lines = path.read_text(errors="replace").splitlines()
    except OSError as error:
        raise InputError(f"{where}: cannot be read: {error.strerror}") from None
    if option == FILE_OPTIONS[1]:
        return
    for number, line in enumerate(lines, 1):
        tokens = TOKEN.findall(line.partition("#")[0])
        if not _is_an_option(tokens):
            raise InputError(f"{where}: line {number} is no option with its value: {printable(line.strip(), 60)}")
        if tokens[:1] == [FILE_OPTIONS[0]] and depth < MOST_NESTED:
            _check_file(tokens[-1] if len(tokens) > 1 else "", FILE_OPTIONS[0], depth + 1)


def _is_an_option(tokens: list[str]) -> bool:
    """Whether PETSc takes the tokens of a line: an option, with or without a value; an alias; nothing."""
    if not tokens or (tokens[0] == "alias" and len(tokens) == 3):
        return True
    value = tokens[1] if len(tokens) > 1 else ""
    return bool(OPTION.match(tokens[0])) and len(tokens) <= 2 and not re.match("-[A-Za-z]", value)


def _message(text: str) -> str:
    """Subject of an error that PETSc printed: its last line before the one on where to find help."""
    lines = re.findall(r"^\[\d+\]PETSC ERROR: (.+)$", text.partition("PETSC ERROR: See ")[0], re.MULTILINE)
    return printable(lines[-1].strip(), 200) if lines else ""


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
