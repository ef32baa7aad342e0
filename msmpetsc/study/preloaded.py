"""The first import of the fork server (study.forkserver), by name: MPI is to begin in each run, not in the server."""

import mpi4py

mpi4py.rc.initialize = False
