"""What a run cost, as `--measure` writes it: where the time went, memory, and on what machine."""

import json
import platform
import resource
import shlex
import sys
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from mpi4py import MPI

from msmpetsc import __version__
from msmpetsc.backend.arrays import on_host
from msmpetsc.backend.machine import machine
from msmpetsc.comm import on_root
from msmpetsc.errors import InputError, StepFailed

if TYPE_CHECKING:  # imports PETSc, which must first be given its options
    from msmpetsc.solve.simulate import Simulation


class Cost:
    """Of one run: ``setup`` [s] until its first step, then summed as frames come."""

    def __init__(self, comm: MPI.Comm, simulation: "Simulation", setup: float):
        self.comm, self.simulation, self.setup = comm, simulation, setup
        self.output = self.stepping = 0.0  # [s]
        model = simulation.model
        own = len(model.lattice.cells), model.lattice.owned, model.lattice.springs_owned, simulation.integrator.unknowns
        self.counts = dict(zip(("cells", "nodes", "springs", "unknowns"), map(comm.allreduce, own), strict=True))

    def add(self, stepping: float, begun: float) -> None:
        """A frame that took ``stepping`` [s] is written, which was ``begun`` at that count of perf_counter."""
        self.stepping += stepping
        self.output += perf_counter() - begun

    def write(self, path: Path, failure: StepFailed | None = None) -> None:
        """Leave it all in a file (collective). Raises InputError where that cannot be written."""
        from msmpetsc.solve.instrumentation import times
        from msmpetsc.solve.integrators.stability_limit import explicit_limit

        comm, simulation = self.comm, self.simulation
        device = "cpu" if on_host(simulation.model.lattice.nodes) else "cuda"
        told = {"machine": machine(), "device": device, "versions": versions(), "ranks": comm.size}
        told |= {"command": shlex.join(["msmpetsc", *sys.argv[1:]]), **self.counts}
        own = {"setup": self.setup, "output": self.output, "stepping": self.stepping}
        told["time"] = {name: comm.allreduce(seconds, MPI.MAX) for name, seconds in own.items()} | times(comm)
        told["time"]["setup"] -= min(told["time"]["factor"], told["time"]["setup"])
        told["memory"] = comm.allreduce(peak_memory())
        told["trace"] = simulation.trace
        told["explicit_limit"] = explicit_limit(comm, simulation.model.lattice, simulation.elasticity)
        told["failure"] = failure and {"kind": failure.kind, "frame": failure.frame, "says": str(failure)}
        on_root(comm, lambda: _write(path, json.dumps(told, indent=1)))


def refuse_unwritable(path: Path | None) -> None:
    """Raises InputError before the run rather than after it."""
    if path:
        was_there = path.exists()
        _write(path, "", "a")
        if not was_there:
            path.unlink()


def _write(path: Path, text: str, mode: str = "w") -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, mode, encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def peak_memory() -> int:
    """The most of this process that ever was resident [byte]; getrusage would count that of its parent, too, as it
    was when this process was started."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    found = [int(line.split()[1]) for line in lines if line.startswith("VmHWM:")]
    return 1024 * (found[0] if found else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def versions() -> dict:
    from petsc4py import PETSc

    petsc = ".".join(map(str, PETSc.Sys.getVersion()))
    return {"msmpetsc": __version__, "petsc": petsc, "python": platform.python_version()}
