"""The first that a server of runs imports (study.forkserver): MPI is not to wake in it, but in each run."""

import mpi4py

mpi4py.rc.initialize = False
