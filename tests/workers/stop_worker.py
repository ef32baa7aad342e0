"""Run the command line; SIGUSR1 to the last rank stops it: stop_worker.py STEP ARGUMENTS.

The signal comes after STEP, never for -1. Checkpoints are written every second step.
"""

import signal
import sys

import petsc4py
import pytest

petsc4py.init(["msmpetsc"])
from mpi4py import MPI  # noqa: E402
from stopped_runs import signal_after  # noqa: E402

from msmpetsc.cli.main import main  # noqa: E402
from msmpetsc.solve import simulate  # noqa: E402

simulate.REMEMBERED = 2
if MPI.COMM_WORLD.rank == MPI.COMM_WORLD.size - 1:
    signal_after(pytest.MonkeyPatch(), int(sys.argv[1]), signal.SIGUSR1)
sys.exit(main(sys.argv[2:]))
