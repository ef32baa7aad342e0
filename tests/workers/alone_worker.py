"""The command line with failing ranks: alone_worker.py RANKS PLACE ERROR ARGUMENTS."""

import sys

from mpi4py import MPI

from msmpetsc.app import abort
from msmpetsc.cli.main import main
from msmpetsc.errors import InputError

ERRORS = {
    "input": lambda: InputError("it fails"),
    "memory": lambda: MemoryError("Unable to allocate it all"),
}


def fail_at(place: str, error: str, fails: bool) -> None:
    import petsc4py

    petsc4py.init(["msmpetsc"])
    from msmpetsc import build
    from msmpetsc.solve.integrators.implicit import ImplicitEuler

    owner, name = {"model": (build, "build_lattice"), "step": (ImplicitEuler, "advance")}[place]
    function, calls = getattr(owner, name), []

    def failing(*given, **named):
        calls.append(1)
        if fails and len(calls) == (1 if place == "model" else 3):
            raise ERRORS[error]()
        return function(*given, **named)

    setattr(owner, name, failing)


if __name__ == "__main__":
    failing = [int(rank) for rank in sys.argv[1].split(",")]
    # the other ranks have seconds to be ended in, whatever else the machine does
    if MPI.COMM_WORLD.rank == failing[0]:
        abort.PATIENCE = 1.0
    fail_at(*sys.argv[2:4], fails=MPI.COMM_WORLD.rank in failing)
    sys.exit(main(sys.argv[4:]))
