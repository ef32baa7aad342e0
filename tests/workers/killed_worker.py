"""Run msmpetsc until rank 0 dies after so much CPU time: killed_worker.py SECONDS run ...

Rank 0 dies by the default action of SIGPROF, as by SIGKILL: nothing is cleaned up. CPU time makes
the moment independent of other work on the machine. With 0 seconds nothing dies. The CPU time of a
finished run is printed.
"""

import signal
import sys
import time

from mpi4py import MPI

from msmpetsc.cli.main import main

if MPI.COMM_WORLD.rank == 0:
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_PROF, float(sys.argv[1]))
begin = time.process_time()
status = main(sys.argv[2:])
signal.setitimer(signal.ITIMER_PROF, 0)
if MPI.COMM_WORLD.rank == 0:
    print("seconds", time.process_time() - begin)
sys.exit(status)
