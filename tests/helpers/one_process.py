"""Many commands in one process, and the lines of error among what they print."""

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


def errors(told: str) -> list[str]:
    return [line for line in told.splitlines() if line.startswith("msmpetsc: error:")]
