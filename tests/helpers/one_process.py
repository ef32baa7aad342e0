"""Many commands in one process, and the lines of error among what they print."""

import contextlib
import io
from collections.abc import Callable

import pytest

from msmpetsc.cli.main import main
from msmpetsc.errors import InputError

IN_ONE_PROCESS = """
import contextlib, io, json, sys
from mpi4py import MPI
from msmpetsc.cli.main import main
for arguments in json.loads(sys.argv[1]):
    told = io.StringIO()
    with contextlib.redirect_stderr(told):
        status = main(arguments)
    answers = MPI.COMM_WORLD.gather((status, told.getvalue()))
    if answers:
        print(json.dumps(answers), flush=True)
"""


def errors(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("msmpetsc: error:")]


def command_error(*arguments: object) -> str:
    """Return the one line of error with which a command ends, status 2; of notes there may be more."""
    stream = io.StringIO()
    with contextlib.redirect_stderr(stream):
        status = main([*map(str, arguments)])
    (line,) = (line for line in stream.getvalue().splitlines() if "note:" not in line and not line.startswith("frame "))
    assert status == 2 and errors(line) == [line], stream.getvalue()
    return line


def input_error(call: Callable[[], object]) -> str:
    """Return what the InputError of a call says, in one line."""
    with pytest.raises(InputError) as raised:
        call()
    assert "\n" not in str(raised.value)
    return str(raised.value)
