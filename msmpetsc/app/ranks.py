"""The ranks of a program, and the environment of the processes that it starts."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from mpi4py import MPI

# variables that launchers set: Open MPI, MPICH, PMIx, Slurm, Flux, Cray and IBM
LAUNCHED = {
    "OMPI_COMM_WORLD_RANK", "PMI_RANK", "PMIX_RANK", "SLURM_PROCID", "FLUX_TASK_RANK",
    "ALPS_APP_PE", "PALS_RANKID", "JSM_NAMESPACE_RANK", "MPI_LOCALRANKID", "MV2_COMM_WORLD_RANK",
}  # fmt: skip
# settings for a single process: no daemon and no network search, which slow its start,
# and no shared session folder, which another process may delete
ALONE = {
    "OMPI_MCA_ess_singleton_isolated": "1", "OMPI_MCA_pml": "ob1",
    "OMPI_MCA_orte_create_session_dirs": "0",
}  # fmt: skip
# prefixes of variables that a launcher sets for this process, not for its children
VARIABLES_OF_MPI = (
    "PMIX_", "PMI_", "OMPI_COMM_WORLD_", "OMPI_UNIVERSE_", "OMPI_MCA_ess", "OMPI_MCA_orte_ess_",
    "OMPI_MCA_orte_hnp_uri", "OMPI_MCA_orte_local_daemon_uri", "OMPI_MCA_orte_jobfam_",
    "OMPI_MCA_pmix",
)  # fmt: skip
# largest number of ranks [-]; far above any machine
MOST_RANKS = 10**6
# settings of Open MPI 4 and 5 that allow more ranks than cores
OVERSUBSCRIBED = {
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
    "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",
}


class OneProcess:
    """Substitute for the communicator of a process that no launcher started."""

    rank, size = 0, 1


def world(started: bool = False) -> "MPI.Comm":
    """Return the communicator of all ranks, or a substitute for a single process.

    started : whether to start MPI in any case. If False, start it only in a process of a launcher,
        because a start takes 0.1 s, and return the substitute if the start fails.
    """
    launched = bool(LAUNCHED & os.environ.keys())
    if not (started or launched):
        return cast("MPI.Comm", OneProcess())
    try:
        with _variables({} if launched else ALONE):
            from mpi4py import MPI
    # MPI is missing or broken, for example on a login node: only commands that run on
    # ranks report that
    except (ImportError, RuntimeError):
        if started:
            raise
        return cast("MPI.Comm", OneProcess())
    return MPI.COMM_WORLD


@contextmanager
def _variables(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables during the block, except variables that the user has set."""
    added = {name: value for name, value in values.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def last_error(output: str) -> str:
    """Return why a child process failed: its last error message, or else its last line."""
    # mpiexec frames its messages with lines of dashes
    lines = [line.strip() for line in output.splitlines() if line.strip(" -")]
    if any("attempt to run as root" in line for line in lines):
        return (
            "mpiexec starts no ranks as root: set OMPI_ALLOW_RUN_AS_ROOT=1 and "
            "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1"
        )
    errors = [line for line in lines if "msmpetsc: error:" in line]
    return (errors or lines or [""])[-1].removeprefix("msmpetsc: error: ")[:500]


def environment(alone: bool = False) -> dict[str, str]:
    """Return the environment of a child process, without this process's MPI variables.

    alone : whether the child is a single process without a launcher
    """
    inherited = {
        name: value for name, value in os.environ.items() if not name.startswith(VARIABLES_OF_MPI)
    }
    # one thread on each rank, because more threads than cores slow all ranks
    return {"OMP_NUM_THREADS": "1"} | OVERSUBSCRIBED | (ALONE if alone else {}) | inherited
