"""First import of the fork server (forked.py): it keeps MPI from starting, and prepares numba."""

import mpi4py
from numba.core.registry import cpu_target

mpi4py.rc.initialize = False
# otherwise each forked process repeats this before its first kernel
cpu_target.typing_context.refresh()
cpu_target.target_context.refresh()
