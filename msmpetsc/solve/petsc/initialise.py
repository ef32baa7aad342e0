"""Start PETSc with the user's options, and lend options to a PETSc that runs already.

Most options that belong to no solver are read by PETSc only at its start.
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
# options that PETSc reads whenever it makes an object
READ_BY_OBJECTS = re.compile(r"(^|_)(snes|ksp|pc|mat|vec|mg|sub|eps|st)_")
TOKEN = re.compile(r'"[^"]*"?|\S+')


def initialise(comm: MPI.Comm, words: list[str]) -> None:
    """Start PETSc (collective).

    words : options and values, as on the command line; PETSc adds PETSC_OPTIONS and .petscrc

    Raises InputError if an options file cannot be read or PETSc refuses a value at its start.
    """
    # Only rank 0 of PETSc reads options files. An error there would block other ranks.
    on_root(comm, lambda: _check_words(words))
    failed = None
    with _captured_stderr() as text:
        try:
            petsc4py.init(["msmpetsc", *words])
        # PETSc.Error cannot be imported before PETSc is initialised.
        except RuntimeError as error:
            failed = error
    if failed is not None:
        # PETSc's hints on further help follow the message.
        message = text[0].partition("PETSC ERROR: See ")[0]
        lines = re.findall(r"^\[\d+\]PETSC ERROR: (.+)$", message, re.MULTILINE) or [str(failed)]
        raise InputError(
            f"PETSc cannot start with its options: {printable(lines[-1].strip(), 200)}"
        )
    if text[0]:
        sys.stderr.write(text[0])


def _check_words(words: list[str]) -> None:
    """Raise InputError for options that end the process and for files out of reach."""
    words = [*os.environ.get("PETSC_OPTIONS", "").split(), *words, ""]
    for option, name in pairwise(words):
        if option in NOT_HERE:
            raise InputError(f"{option}: {NOT_HERE[option]}")
        # type:file:format; PETSc opens some files only at the end of the process
        files = [view.split(":")[1] for view in name.split(",") if ":" in view]
        for file in files if option.endswith("_view") else ():
            if not Path(file).parent.is_dir():
                raise InputError(f"{option}: no folder {printable(str(Path(file).parent))}")
        if option not in FILE_OPTIONS:
            continue
        where = f"{option} {printable(name)}"
        if not name or OPTION.match(name):
            raise InputError(f"{option}: names no file")
        if not Path(name).is_file() or not os.access(name, os.R_OK):
            raise InputError(f"{where}: no readable file of this name")
        if option == FILE_OPTIONS[0]:
            _check_lines(where, Path(name).read_text(errors="replace").splitlines())


def _check_lines(where: str, lines: list[str]) -> None:
    """Raise InputError for a line that is neither an option, with or without value, nor alias."""
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
    """Capture the standard error of the process, C code included; yield a list for its text.

    The list has the text after the block.
    """
    text = [""]
    sys.stderr.flush()
    saved_stderr = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield text
        finally:
            ctypes.CDLL(None).fflush(None)
            os.dup2(saved_stderr, 2)
            os.close(saved_stderr)
            file.seek(0)
            text[0] = file.read().decode(errors="replace")


def is_running() -> bool:
    """Return whether this process has started PETSc."""
    module = sys.modules.get("petsc4py.PETSc")
    return module is not None and module.Sys.isInitialized() and not module.Sys.isFinalized()


@atexit.register
def finalise() -> None:
    """Finalise PETSc, if it runs, before Python ends (collective).

    PETSc destroys the remaining objects. A PC of type python calls Python to destroy itself.
    """
    if is_running():
        sys.modules["petsc4py.PETSc"]._finalize()


def start_for_runs(comm: MPI.Comm, words: Sequence[str]) -> None:
    """Start PETSc, unless it runs, with the options that it reads only at its start (collective).

    ``lent_options`` lends the remaining options for the time of a run.
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
    """Start PETSc with options; if it runs already, lend it the options for the block (collective).

    Raises InputError for options that a running PETSc no longer reads.
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
                f"-{name}: PETSc runs already and reads this option only at its start: give it to "
                "the first run"
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
