"""Run many commands in one process, and find the lines of error in their output."""

import contextlib
import io
import json
import subprocess
from collections.abc import Callable, Sequence

import pytest
from conftest import run

from msmpetsc.cli.main import main
from msmpetsc.errors import InputError

IN_ONE_PROCESS = """
import contextlib, gc, io, json, sys
from mpi4py import MPI
from msmpetsc.cli.main import main
for arguments in json.loads(sys.argv[1]):
    told = io.StringIO()
    with contextlib.redirect_stderr(told):
        status = main(arguments)
    answers = MPI.COMM_WORLD.gather((status, told.getvalue()))
    if answers:
        print(json.dumps(answers), flush=True)
gc.collect()
from petsc4py import PETSc
PETSc.garbage_view()
"""


# status and message of each rank
Answers = list[tuple[int, str]]


def answers_on(ranks: int, commands: Sequence[Sequence[object]]) -> list[Answers]:
    """Return the status and message of each rank for each command, all run by one process a rank.

    No PETSc object is left to Python's collector, because at its end PETSc waits for objects that
    only one rank has collected.
    """
    words = [[*map(str, command)] for command in commands]
    done = run(ranks, "-c", IN_ONE_PROCESS, json.dumps(words), status=0)
    assert done.stderr.strip() == "", "not even the C libraries speak"
    lines = done.stdout.splitlines()
    assert ranks == 1 or sum(line.endswith("Total entries: 0") for line in lines) == ranks, lines
    return [json.loads(line) for line in lines if line.startswith("[")]


def refusal_in(answers: Answers) -> str:
    """Return the line, from a single rank, with which all ranks refuse a command."""
    assert all(status == 2 for status, _ in answers), answers
    (line,) = (line for _, told in answers for line in told.splitlines() if not is_aside(line))
    assert errors(answers[0][1]) == [line], answers
    return line


def is_aside(line: str) -> bool:
    """Return whether a line is a note, or warns that two cells of springs are thin."""
    return "note:" in line or "is so thin" in line


def errors(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("msmpetsc: error:")]


NOISE = ("Traceback", "PETSC ERROR", "MPI_ABORT", "ORTE_ERROR", "Segmentation", "SEGV", "Warning")


def assert_one_line(done: subprocess.CompletedProcess, status: int, *words: str) -> None:
    """Assert that a command ended with this status and a single line that contains these words."""
    told = done.stdout + done.stderr
    (line,) = errors(done.stderr)
    assert done.returncode == status and all(word in line for word in words), told
    assert not [noise for noise in NOISE if noise in told], told


def status_of(*arguments: object) -> int:
    """Run a command in this process and return its exit status."""
    return main([*map(str, arguments)])


def command_error(*arguments: object) -> str:
    """Return the line of error of a command that ends with status 2; notes may precede it."""
    stream = io.StringIO()
    with contextlib.redirect_stderr(stream):
        status = status_of(*arguments)
    (line,) = (
        line
        for line in stream.getvalue().splitlines()
        if not is_aside(line) and not line.startswith("frame ")
    )
    assert status == 2 and errors(line) == [line], stream.getvalue()
    return line


def input_error(call: Callable[[], object]) -> str:
    """Return the message of the InputError that a call raises, a single line."""
    with pytest.raises(InputError) as raised:
        call()
    assert "\n" not in str(raised.value)
    return str(raised.value)
