"""What a run says on stderr: rank 0 alone, from bodies and counts to the files it leaves."""

import shlex
from collections.abc import Iterable
from pathlib import Path
from signal import Signals

import numpy as np
from mpi4py import MPI
from tqdm import tqdm

from msmpetsc.app.checkpointing import STATUS
from msmpetsc.build import Model
from msmpetsc.comm import log
from msmpetsc.constraints.coverage import Reach
from msmpetsc.lattice.material import STEPS_A_PERIOD, bending_period
from msmpetsc.results.progress_bar import duration
from msmpetsc.scene.reading import Scene
from msmpetsc.solve.simulate import TimeLoop


def log_model(comm: MPI.Intracomm, model: Model) -> None:
    """Log size, volume and mass of each body, counts, and the nodes that anchors and forces take (collective)."""
    lattice = model.lattice
    masses = np.bincount(lattice.body[: lattice.owned], lattice.mass, len(model.bodies))
    shares = np.bincount(lattice.body_of(lattice.cells[:, 0]), lattice.cell_share, len(model.bodies))
    sums = comm.allreduce(np.array([masses, shares * lattice.cell_size**3]))
    for number, (body, (mass, volume)) in enumerate(zip(model.bodies, sums.T, strict=True)):
        mesh = f"open mesh ({body.report.boundary_edges} boundary edges), its volume unknown"
        if body.report.closed:
            enclosed = abs(body.report.volume)
            mesh = f"closed mesh of {enclosed:.4g} m^3, {mass / volume * enclosed:.4g} kg"
        name = f"body.{number}" if len(model.bodies) > 1 else "body"
        size = " x ".join(f"{length:.4g}" for length in body.bounds[1] - body.bounds[0])
        log.info("%s of %s m; %s; lattice of %.4g m^3, %.4g kg", name, size, mesh, volume, mass)
    held = int(lattice.pinned[: lattice.owned].sum())
    cells, springs, pinned = (comm.allreduce(number) for number in (len(lattice.cells), lattice.springs_owned, held))
    log.info(
        "%d cells of %.4g m, %d nodes (%d pinned), %d springs on %d rank%s",
        cells, lattice.cell_size, lattice.table.total, pinned, springs, comm.size, "s" * (comm.size > 1),
    )  # fmt: skip
    if named := taken(model.reaches):
        log.info("%s", ", ".join(named))


def warn_of_long_steps(scene: Scene, model: Model) -> None:
    """Warn of steps that are longer than the slowest motion of any body, which implicit steps damp away.

    That is taken to be the bending of a bar of the body's longest and shortest side: of most bodies it is not so slow.
    """
    time = scene.time
    if time.integrator not in ("implicit-euler", "bdf2") or time.error is not None:
        return
    moduli = [body.material and body.material.young_modulus for body in scene.body] or [None]
    softest = min((modulus or scene.material.young_modulus or np.inf) for modulus in moduli)
    lengths = [body.bounds[1] - body.bounds[0] for body in model.bodies]
    period = max(bending_period(sides.max(), sides.min(), softest, scene.material.density) for sides in lengths)
    if time.step > period > 0:
        log.warning(
            "time.step is %.2g periods of the slowest vibration, about %.1g s, which it damps away: time.step = %.1g "
            'shows it, time.integrator = "static" goes to rest at once',
            time.step / period, period, period / STEPS_A_PERIOD,
        )  # fmt: skip


def taken(reaches: Iterable[Reach]) -> list[str]:
    """Name what each anchor and force takes; of a force's nodes some may be held."""
    named = []
    for reach in reaches:
        if reach.kind == "anchor":
            named.append(f"{reach.key} leads {reach.nodes - reach.held} nodes")
        elif reach.kind == "force":
            held = f" ({reach.held} of them held)" if reach.held else ""
            named.append(f"{reach.key} pulls {reach.nodes} nodes{held}")
    return named


def log_end(frames: int, seconds: float, setup: float, files: Iterable[Path]) -> None:
    """Log how long it took [s], and which files there are; the first of them holds the frames."""
    sizes = {path: tqdm.format_sizeof(path.stat().st_size, "B") for path in files if path.is_file()}
    result, *others = (f"{path} ({size})" for path, size in sizes.items())
    log.info("took %s, %s of it before the first step", spoken(seconds), spoken(setup))
    log.info("left %d frame%s in %s", frames, "s" * (frames != 1), ", ".join([result, *others]))


def spoken(seconds: float) -> str:
    """Return a time as a person would say it; short ones with a digit more."""
    return f"{seconds:.1f} s" if seconds < 10 else duration(seconds)


def tell_stop(number: int, path: Path, simulation: TimeLoop) -> int:
    """Say in one line how to go on after a signal; return the exit status of that signal."""
    log.warning(
        "stopped by %s after step %d of %d (t = %.6g s); to go on: msmpetsc run --resume %s",
        Signals(number).name, simulation.step, simulation.steps, simulation.step * simulation.time_step,
        shlex.quote(str(path)),
    )  # fmt: skip
    return STATUS[number]
