"""The command line, stopped by SIGUSR1 to the last rank after a step: stop_worker.py STEP ARGUMENTS; -1 for never.
Checkpoints are of every second step."""

import os
import signal
import sys

from mpi4py import MPI

from msmpetsc.cli.main import main


def stop_after(step: int) -> None:
    import petsc4py

    petsc4py.init(["msmpetsc"])
    from msmpetsc.solve import simulate
    from msmpetsc.solve.simulate import TimeLoop

    simulate.REMEMBERED = 2
    advance = TimeLoop.advance

    def watched(simulation):
        for frame in advance(simulation):
            if simulation.step == step and MPI.COMM_WORLD.rank == MPI.COMM_WORLD.size - 1:
                os.kill(os.getpid(), signal.SIGUSR1)
            yield frame

    TimeLoop.advance = watched


if __name__ == "__main__":
    stop_after(int(sys.argv[1]))
    sys.exit(main(sys.argv[2:]))
