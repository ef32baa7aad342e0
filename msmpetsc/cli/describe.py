"""What a run says of itself: at its start what it is made of, at its end how long it took and which files it left."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from mpi4py import MPI
from tqdm import tqdm

from msmpetsc.comm import log
from msmpetsc.output.progress import duration

if TYPE_CHECKING:  # imports PETSc, which must first be given its options
    from msmpetsc.model.build import Model
    from msmpetsc.model.reach import Reach

MOST_NAMED = 12  # tables whose nodes are counted one by one


def log_model(comm: MPI.Comm, model: "Model") -> None:
    """Size of the body, counts of the lattice, volumes and masses side by side, nodes that the scene's tables take
    (collective)."""
    lattice, body = model.lattice, model.body
    held = int(lattice.pinned[: lattice.owned].sum())
    own = len(lattice.cells), lattice.springs_owned, held, float(lattice.mass.sum())
    cells, springs, pinned, mass = (comm.allreduce(number) for number in own)
    volume, enclosed = cells * lattice.cell_size**3, abs(body.report.volume)
    mesh = f"open mesh ({body.report.boundary_edges} boundary edges), its volume unknown"
    if body.report.closed:
        mesh = f"closed mesh of {enclosed:.4g} m^3, {mass / volume * enclosed:.4g} kg"
    size = sides(body.bounds[1] - body.bounds[0])
    log.info("body of %s m; %s; lattice of %.4g m^3, %.4g kg", size, mesh, volume, mass)
    log.info(
        "%d cells of %.4g m, %d nodes (%d pinned), %d springs on %d rank%s",
        cells, lattice.cell_size, lattice.table.total, pinned, springs, comm.size, "s" * (comm.size > 1),
    )  # fmt: skip
    if named := taken(model.reaches):
        log.info("%s", ", ".join(named))


def sides(lengths: Iterable[float]) -> str:
    """0.3 x 0.2325 x 0.2974"""
    return " x ".join(f"{length:.4g}" for length in lengths)


def taken(reaches: Iterable["Reach"]) -> list[str]:
    """What each anchor and force takes; of a force's nodes some may be held, which take their share of it, too."""
    named = []
    for reach in reaches:
        if reach.key.startswith("anchor"):
            named.append(f"{reach.key} leads {reach.nodes - reach.held} nodes")
        elif reach.key.startswith("force"):
            held = f" ({reach.held} of them held)" if reach.held else ""
            named.append(f"{reach.key} pulls {reach.nodes} nodes{held}")
    more = len(named) - MOST_NAMED
    return named if more <= 1 else [*named[:MOST_NAMED], f"and {more} more"]


def log_end(frames: int, seconds: float, setup: float, files: Iterable[Path]) -> None:
    """How long it took [s], and which files there are; the first of them holds the frames."""
    sizes = {path: tqdm.format_sizeof(path.stat().st_size, "B") for path in files if path.is_file()}
    result, *others = (f"{path} ({size})" for path, size in sizes.items())
    log.info("took %s, %s of it before the first step", spoken(seconds), spoken(setup))
    log.info("left %d frame%s in %s", frames, "s" * (frames != 1), ", ".join([result, *others]))


def spoken(seconds: float) -> str:
    """A time as a person would say it; short ones with a digit more."""
    return f"{seconds:.1f} s" if seconds < 10 else duration(seconds)
