"""The first import of the fork server, which keeps MPI from starting in the server itself."""

import mpi4py
from numba.core.registry import cpu_target

mpi4py.rc.initialize = False
cpu_target.typing_context.refresh()  # what each run's first kernel would wait for
cpu_target.target_context.refresh()
