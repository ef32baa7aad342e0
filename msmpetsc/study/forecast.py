"""What a run would need on R ranks, from two short runs of its scene here, on one rank and coarser lattices.

    memory of a rank  =  program + f (bytes of the arrays that it holds while A is assembled), or W is made if more,
    time of a step    =  (its + w (iterations + 1)) (a + b s) + messages,       s the springs of a rank

f, a and b go through the two runs; so do ``its`` of KSP, as a power of the cells. Outer ``iterations`` are those of the
finer run (verlet's substeps grow as its do); w KSP iterations are counted for what is done spring by spring in each.
"""

import hashlib
import json
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pooch
import trimesh

from msmpetsc import __version__
from msmpetsc.errors import InputError
from msmpetsc.geometry.surface import Surface
from msmpetsc.model.partition import Shares
from msmpetsc.scene.schema import Scene
from msmpetsc.study.cases import Case, digest, inline
from msmpetsc.study.process import Processes
from msmpetsc.study.runner import Bench
from msmpetsc.study.table import Row

COARSE, FINE = 1000, 20_000  # cells of the two runs, at most
LONGEST = 300.0  # [s] a run
POSITION = 24  # bytes of three doubles
# Bytes held at once when memory is at its greatest, in solve.linear.system.assemble: the lattice's own arrays (model.lattice),
AT_CELL = 8 * 8 + 8 * 8 + 1 + 8  # cells, local_cells, cell_kind, key
AT_NODE = POSITION + 8 + 8 + 1 + 8 + POSITION + 8  # nodes, key, mass, pinned, numbers, places, row
AT_SPRING = 16 + 8 + 8 + 8 + 32 + 2  # springs, rest_length, stiffness, weight, both ends, kept
AT_NONZERO = 5 * 8 + 2 * 4 + 12  # rows, nodes, values, the last two again, COO's and CSR's numbers, PETSc's entry
AT_POINT = 14 * 64 * 8  # of the surface, while W is made of up to 64 weights each; as seen with "affine"
STEEPEST = 1 / 3  # power of the cells that its may grow with: the cells along a side, as with Jacobi
OTHER = 5  # w: a gradient, a Hessian, two or more energies, sums over vectors
# Of one step, counted in solve.nonlinear.step and PETSc's CG: exchanges of ghosts and sums over all ranks
EXCHANGES_OF_ITS, EXCHANGES_OF_ITERATION = 1, 4
SUMS_OF_ITS, SUMS_OF_ITERATION = 3, 10


class Network(NamedTuple):
    """latency [s] of a message, bandwidth [byte/s] of a rank."""

    latency: float
    bandwidth: float


@dataclass(frozen=True)
class Trial:
    """One short run on one rank; iterations and its are means a step."""

    cells: float
    nodes: float
    springs: float
    nonzeros: float
    memory: float  # [byte]
    time: float  # [s] of a step
    iterations: float
    its: float

    @classmethod
    def of(cls, row: Row) -> "Trial":
        counts = row["cells"], row["nodes"], row["springs"], row["unknowns"] + 2 * row["springs"]
        return cls(*counts, row["memory"], row["time_frame"], row["iterations"], row["ksp_its"])

    @property
    def unit(self) -> float:
        """[s] a KSP iteration."""
        return self.time / units(self.its, self.iterations)

    @property
    def held(self) -> float:
        """[byte]"""
        return held(self.cells, self.nodes, self.springs, self.nonzeros)


def units(its: float, iterations: float) -> float:
    """KSP iterations that a step is worth."""
    return its + OTHER * (iterations + 1)


def held(cells, nodes, springs, nonzeros):
    """Bytes of arrays that a rank holds of so many."""
    return AT_CELL * cells + AT_NODE * nodes + AT_SPRING * springs + AT_NONZERO * nonzeros


@dataclass(frozen=True)
class Forecast:
    """From a run on a coarse and one on a fine lattice."""

    coarse: Trial
    fine: Trial

    @property
    def program(self) -> float:
        """Bytes of a rank that holds nothing."""
        return max(0.0, self.coarse.memory - self._memory_of_byte * self.coarse.held)

    @property
    def _memory_of_byte(self) -> float:
        return max(0.0, _slope(self.coarse.held, self.coarse.memory, self.fine.held, self.fine.memory))

    def memory(self, shares: Shares, points: int = 0, mesh: float = 0.0) -> np.ndarray:
        """(R,) [byte].

        points : of the surface, where it is stored
        mesh   : bytes that the surface needs on rank 0 while it is prepared
        """
        arrays = held(shares.cells, shares.nodes + shares.ghosts, shares.springs, shares.nonzeros)
        needed = np.maximum(self._memory_of_byte * arrays, AT_POINT * points / shares.ranks)
        needed[0] = max(needed[0], mesh)
        return self.program + needed

    def its(self, cells: float) -> float:
        """KSP iterations of a step of so many cells."""
        return self._grown("its", cells)

    def iterations(self, cells: float) -> float:
        """Outer ones; where nothing is solved they are substeps, and grow as the cells along a side do."""
        return self.fine.iterations if self.fine.its else self._grown("iterations", cells)

    def _grown(self, name: str, cells: float) -> float:
        """As the power of the cells that goes through the two runs."""
        coarse, fine = getattr(self.coarse, name), getattr(self.fine, name)
        if not min(coarse, fine) > 0 or self.fine.cells <= self.coarse.cells:
            return fine
        power = math.log(fine / coarse) / math.log(self.fine.cells / self.coarse.cells)
        return fine * (cells / self.fine.cells) ** min(max(power, 0.0), STEEPEST)

    def computing(self, shares: Shares) -> float:
        """[s] a step, of the rank that has most springs."""
        coarse, fine = self.coarse, self.fine
        unit = _line(shares.springs.max(), coarse.springs, coarse.unit, fine.springs, fine.unit)
        cells = shares.cells.sum()
        return units(self.its(cells), self.iterations(cells)) * unit

    def messages(self, shares: Shares, network: Network) -> float:
        """[s] a step, of the rank whose ghosts take longest."""
        cells = shares.cells.sum()
        its, iterations = self.its(cells), self.iterations(cells) + 1
        exchange = (shares.neighbours * network.latency + shares.ghosts * POSITION / network.bandwidth).max()
        total = 2 * math.ceil(math.log2(shares.ranks)) * network.latency  # a sum: there and back through a tree
        exchanges = EXCHANGES_OF_ITS * its + EXCHANGES_OF_ITERATION * iterations
        return exchanges * exchange + (SUMS_OF_ITS * its + SUMS_OF_ITERATION * iterations) * total


def _slope(x0: float, y0: float, x1: float, y1: float) -> float:
    return (y1 - y0) / (x1 - x0) if x1 > x0 else 0.0


def _line(x: float, x0: float, y0: float, x1: float, y1: float) -> float:
    """At x, on the line through two points; never falling with x, nor below zero at none."""
    slope = min(max(_slope(x0, y0, x1, y1), 0.0), y1 / x1)
    return y1 + slope * (x - x1)


def forecast(
    file: Path,
    changes: Sequence[str],
    options: str,
    scene: Scene,
    surface: Surface,
    cells: float,
    frames: int,
    again: bool,
) -> Forecast:
    """From two runs of the first ``frames`` steps of a scene of so many ``cells``; those that were made here before
    stand in the user's cache, unless they are to be made ``again``. Raises InputError where a run fails.

    surface : prepared
    """
    known = _known(file, options, scene, frames)
    if known.is_file() and not again:
        rows = json.loads(known.read_text())
    else:
        rows = _measured(file, changes, options, scene, surface, cells, frames)
        known.parent.mkdir(parents=True, exist_ok=True)
        known.write_text(json.dumps(rows))
    return Forecast(*map(Trial.of, rows))


def _known(file: Path, options: str, scene: Scene, frames: int) -> Path:
    """Where the figures of these runs on this processor are kept."""
    what = [digest(file, scene), scene.text, options, frames, __version__, _processor(), COARSE, FINE]
    name = hashlib.sha256(json.dumps(what).encode()).hexdigest()[:16]
    return Path(pooch.os_cache("msmpetsc")) / "trials" / f"{name}.json"


def _processor() -> list[str]:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return [line for line in lines if line.startswith("model name")]


def _measured(
    file: Path, changes: Sequence[str], options: str, scene: Scene, surface: Surface, cells: float, frames: int
) -> list[Row]:
    """The rows of both runs."""
    fine, processes = min(int(cells), FINE), Processes()
    with tempfile.TemporaryDirectory(prefix="msmpetsc-inspect-") as folder:
        mesh = Path(folder) / "surface.obj"
        trimesh.Trimesh(surface.points, surface.triangles, process=False).export(mesh)
        bench = Bench(Path(folder), processes)
        try:
            return [
                _run(bench, _case(file, changes, options, scene, mesh, count, frames))
                for count in (min(COARSE, max(1, fine // 8)), fine)
            ]
        finally:
            processes.stop()


def _run(bench: Bench, case: Case) -> Row:
    row = bench.measure(case).row
    if row["status"] != "ok":
        raise InputError(f"the short run on {case.cells} cells that times are taken from: {row['reason']}")
    return row


def _case(file: Path, changes: Sequence[str], options: str, scene: Scene, mesh: Path, cells: int, frames: int) -> Case:
    """The scene's first frames on so many cells, its surface as it was prepared."""
    cages = scene.cages.model_dump(exclude_unset=True, exclude={"cell_size", "max_cells"}) | {"count": cells}
    time = scene.time
    all_changes = (
        *changes, f"mesh={inline({'source': str(mesh)})}", f"cages={inline(cages)}",
        f"time.duration={min(frames, time.steps) * time.step!r}", "output.surface=false", "output.every=1",
    )  # fmt: skip
    return Case(
        scene=scene.title or file.stem, file=file, content="", set=all_changes, integrator=time.integrator,
        options=options, cells=cells, time_step=time.step, timeout=LONGEST,
    )  # fmt: skip
