"""The first import of the fork server (study.forkserver), by name: MPI is to begin in each run, not in the server."""

import mpi4py
from numba.core.registry import cpu_target

mpi4py.rc.initialize = False
cpu_target.typing_context.refresh()  # what each run's first kernel would wait for
cpu_target.target_context.refresh()
