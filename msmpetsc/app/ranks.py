"""The ranks of a program: started by a launcher, or one process alone; and the environment of its children."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from mpi4py import MPI

LAUNCHED = {  # variables that Open MPI, MPICH, PMIx, Slurm, Flux and the launchers of Cray and IBM set for each rank
    "OMPI_COMM_WORLD_RANK", "PMI_RANK", "PMIX_RANK", "SLURM_PROCID", "FLUX_TASK_RANK", "ALPS_APP_PE", "PALS_RANKID",
    "JSM_NAMESPACE_RANK", "MPI_LOCALRANKID", "MV2_COMM_WORLD_RANK",
}  # fmt: skip
# A process alone needs neither Open MPI's daemon nor its search for a network, a third of a second at its start; nor
# folders that all share: one that ends may take them from under one that begins, which then fails (1 of 300).
ALONE = {
    "OMPI_MCA_ess_singleton_isolated": "1", "OMPI_MCA_pml": "ob1", "OMPI_MCA_orte_create_session_dirs": "0",
}  # fmt: skip
VARIABLES_OF_MPI = (  # of a launcher around us: not for our children
    "PMIX_", "PMI_", "OMPI_COMM_WORLD_", "OMPI_UNIVERSE_", "OMPI_MCA_ess", "OMPI_MCA_orte_ess_",
    "OMPI_MCA_orte_hnp_uri", "OMPI_MCA_orte_local_daemon_uri", "OMPI_MCA_orte_jobfam_", "OMPI_MCA_pmix",
)  # fmt: skip
# more ranks than cores are the user's to ask for: as Open MPI 4 calls it, and as 5 does
OVERSUBSCRIBED = {
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
    "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",
}


class OneProcess:
    """A stand-in for the communicator of a process that no launcher started."""

    rank, size = 0, 1


def world(started: bool = False) -> "MPI.Comm":
    """Return all ranks.

    started : whether MPI must be started, which takes 0.1 s; or else only where a launcher started the process, and
        that MPI can be started
    """
    launched = bool(LAUNCHED & os.environ.keys())
    if not (started or launched):
        return cast("MPI.Comm", OneProcess())
    try:
        with _variables({} if launched else ALONE):
            from mpi4py import MPI
    except (
        ImportError,
        RuntimeError,
    ):  # missing or broken, in a shell of a batch system, say: `run` says so
        if started:
            raise
        return cast("MPI.Comm", OneProcess())
    return MPI.COMM_WORLD


@contextmanager
def _variables(values: dict[str, str]) -> Iterator[None]:
    """Set variables of the environment in the block that the user has not set: what is started later has its own."""
    added = {name: value for name, value in values.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def last_error(output: str) -> str:
    """Return why a child failed: the last line of its output that is an error, or else the last line."""
    lines = [
        line.strip() for line in output.splitlines() if line.strip(" -")
    ]  # without mpiexec's frames
    if any("attempt to run as root" in line for line in lines):
        return "mpiexec starts no ranks as root: set OMPI_ALLOW_RUN_AS_ROOT=1 and OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1"
    errors = [line for line in lines if "msmpetsc: error:" in line]
    return (errors or lines or [""])[-1].removeprefix("msmpetsc: error: ")[:500]


def environment(alone: bool = False) -> dict[str, str]:
    """Return the environment for a child, without the variables of the MPI of this process."""
    ours = {
        name: value for name, value in os.environ.items() if not name.startswith(VARIABLES_OF_MPI)
    }
    # one thread a rank, or ranks and threads would fight for the cores
    return {"OMP_NUM_THREADS": "1"} | OVERSUBSCRIBED | (ALONE if alone else {}) | ours
