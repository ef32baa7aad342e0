"""What a run cost, as `--measure` writes it: where the time went, memory, and on what machine."""

import json
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import psutil
from mpi4py import MPI

from msmpetsc import __version__
from msmpetsc.backend.arrays import on_host
from msmpetsc.backend.machine import machine
from msmpetsc.comm import on_root
from msmpetsc.errors import StepFailed
from msmpetsc.fields import Frame
from msmpetsc.results.disk import plain_errors, refuse_no_file, write_whole

if TYPE_CHECKING:  # imports PETSc, which must first be given its options
    from msmpetsc.solve.simulate import TimeLoop


class Cost:
    """What a run costs, summed frame by frame.

    setup    : seconds until the first step
    output   : seconds in which frames and checkpoints are written
    stepping : seconds of the steps
    products : with the Hessian
    """

    def __init__(self, comm: MPI.Comm, simulation: "TimeLoop", setup: float):
        self.comm, self.simulation, self.setup = comm, simulation, setup
        self.output, self.stepping, self.products = 0.0, 0.0, 0
        model = simulation.model
        free = int((~simulation.environment.fixed_at(simulation.time_step)[: model.lattice.owned]).sum())
        own = len(model.lattice.cells), model.lattice.owned, model.lattice.springs_owned, free
        self.counts = dict(zip(("cells", "nodes", "springs", "unknowns"), map(comm.allreduce, own), strict=True))

    @contextmanager
    def of_output(self) -> Iterator[None]:
        """Count the time of the block as that of output."""
        from msmpetsc.solve.petsc.events import FILES, OUTPUT

        began = perf_counter()
        with OUTPUT, FILES:
            yield
        self.output += perf_counter() - began

    def count(self, frame: Frame) -> None:
        """Count the steps since the frame before."""
        self.stepping += frame.wall_time
        self.products += frame.products

    def write(self, path: Path, command: str, failure: StepFailed | None = None) -> None:
        """Leave it all in a file (collective). Raises InputError where that cannot be written."""
        from msmpetsc.solve.instrumentation import times
        from msmpetsc.solve.integrators.verlet import explicit_limit

        comm, simulation = self.comm, self.simulation
        device = "cpu" if on_host(simulation.model.lattice.nodes) else "cuda"
        own = {"setup": self.setup, "output": self.output, "stepping": self.stepping}
        time = {name: comm.allreduce(seconds, MPI.MAX) for name, seconds in own.items()} | times(comm)
        time["setup"] -= min(time["factor"], time["setup"])
        record = {
            "machine": machine(), "device": device, "versions": versions(), "ranks": comm.size, "command": command,
            **self.counts,
            "time": time,
            "products": self.products,
            "memory": comm.allreduce(peak_memory()),
            "trace": simulation.true_errors.trace,
            "explicit_limit": explicit_limit(comm, simulation.model.lattice, simulation.elasticity),
            "failure": failure and {"kind": failure.kind, "frame": failure.frame, "says": str(failure)},
        }  # fmt: skip
        on_root(comm, lambda: write_whole(path, json.dumps(record, indent=1)))


def refuse_unwritable(path: Path | None) -> None:
    """Raise InputError for a file that cannot be written, before the run rather than after it."""
    if path:
        existed = path.exists()
        with plain_errors(path):
            refuse_no_file(path)
            path.parent.mkdir(parents=True, exist_ok=True)
            open(path, "a").close()
            if not existed:
                path.unlink()


def peak_memory() -> int:
    """Return the most memory of this process that ever was resident [byte].

    getrusage counts that of its parent, too, as it was when this process was started; the kernel's own count does not.
    """
    lines = Path("/proc/self/status").read_text().splitlines() if psutil.LINUX else []
    peaks = [int(line.split()[1]) for line in lines if line.startswith("VmHWM:")]
    return 1024 * peaks[0] if peaks else psutil.Process().memory_info().rss


def versions() -> dict[str, str]:
    """Return the versions of this package, PETSc and Python."""
    from petsc4py import PETSc

    petsc = ".".join(map(str, PETSc.Sys.getVersion()))
    return {"msmpetsc": __version__, "petsc": petsc, "python": platform.python_version()}
