"""``msmpetsc run``: simulate a scene and write its result file."""

import argparse

from mpi4py import MPI

from msmpetsc.app.request import OPTIONS, RunRequest
from msmpetsc.app.start import carry_out, options_shown


def run(args: argparse.Namespace) -> int:
    """Simulate a scene; return the exit status (collective)."""
    comm = MPI.COMM_WORLD
    request = RunRequest(**{name: value for name, value in vars(args).items() if name in OPTIONS})
    if not args.show_options:
        return carry_out(comm, request)
    lines = options_shown(comm, request)
    if comm.rank == 0:
        print("\n".join(lines))
    return 0
