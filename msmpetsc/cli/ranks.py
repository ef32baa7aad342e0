"""The communicator of a command, which starts MPI only if a launcher started the process."""

import os
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from mpi4py import MPI

LAUNCHED = {  # variables that Open MPI, MPICH, PMIx, Slurm, Flux and the launchers of Cray and IBM set for each rank
    "OMPI_COMM_WORLD_RANK", "PMI_RANK", "PMIX_RANK", "SLURM_PROCID", "FLUX_TASK_RANK", "ALPS_APP_PE", "PALS_RANKID",
    "JSM_NAMESPACE_RANK", "MPI_LOCALRANKID", "MV2_COMM_WORLD_RANK",
}  # fmt: skip


class Alone:
    """A stand-in for the communicator of a process that no launcher started."""

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
