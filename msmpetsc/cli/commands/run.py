"""``msmpetsc run``: simulate a scene and write its result file."""

import argparse
import signal
from types import FrameType

from mpi4py import MPI

from msmpetsc.app.request import OPTIONS, RunRequest
from msmpetsc.app.start import carry_out, options_shown
from msmpetsc.comm import Stop


def run(args: argparse.Namespace) -> int:
    """Simulate a scene; return the exit status (collective)."""
    comm = MPI.COMM_WORLD
    request = RunRequest(**{name: value for name, value in vars(args).items() if name in OPTIONS})
    if not args.show_options:
        # the signal must not kill the run while it is set up or writes its last files
        before = signal.signal(signal.SIGUSR1, _ask_to_stop)
        try:
            return carry_out(comm, request)
        finally:
            signal.signal(signal.SIGUSR1, before)
    lines = options_shown(comm, request)
    if comm.rank == 0:
        print("\n".join(lines))
    return 0


def _ask_to_stop(number: int, _: FrameType | None) -> None:
    """Record a signal outside the steps: before the first step, the run stops after that step.

    After the last step the signal has no effect.
    """
    Stop.signal = number
