"""The ranks that a command runs on; most are for one process, and need MPI only to see that there is but one."""

import os
from typing import TYPE_CHECKING, Any, cast

from msmpetsc.errors import InputError

if TYPE_CHECKING:
    from mpi4py import MPI

LAUNCHED = {  # variables that Open MPI, MPICH, PMIx, Slurm, Flux and the launchers of Cray and IBM set for each rank
    "OMPI_COMM_WORLD_RANK", "PMI_RANK", "PMIX_RANK", "SLURM_PROCID", "FLUX_TASK_RANK", "ALPS_APP_PE", "PALS_RANKID",
    "JSM_NAMESPACE_RANK", "MPI_LOCALRANKID", "MV2_COMM_WORLD_RANK",
}  # fmt: skip

RUNS_ITSELF = "it starts its runs on as many ranks as they need"


class Alone:
    """The communicator of a process that no launcher started, as far as one rank asks it."""

    rank, size = 0, 1


def world(started: bool = False) -> "MPI.Comm":
    """Return all ranks.

    started : whether MPI must be started, which takes 0.3 s; or else only where a launcher started the process, and
        that MPI can be started
    """
    if not (started or LAUNCHED & os.environ.keys()):
        return cast("MPI.Comm", Alone())
    try:
        from mpi4py import MPI
    except (ImportError, RuntimeError):  # missing or broken, in a shell of a batch system, say: `run` says so
        if started:
            raise
        return cast("MPI.Comm", Alone())
    return MPI.COMM_WORLD


def refuse_ranks(command: str, why: str) -> None:
    """Raise InputError where mpiexec has started more than one of a command that is for one process alone."""
    if world().size > 1:
        raise InputError(f"{command} is started without mpiexec: {why}")


def interrupt(*_: Any) -> None:
    """Treat a signal to end as Ctrl-C: the runs under way end with this process."""
    raise KeyboardInterrupt
