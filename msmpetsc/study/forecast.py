"""A forecast of what a run would need on R ranks, from two short runs of its scene, on one rank and coarser lattices.

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
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pooch
import trimesh

from msmpetsc import __version__
from msmpetsc.backend.machine import processor
from msmpetsc.errors import InputError
from msmpetsc.geometry.surface import Surface
from msmpetsc.model.lattice import lattice_bytes
from msmpetsc.model.partition import Partition
from msmpetsc.output.disk import write_whole
from msmpetsc.scene.schema import Scene
from msmpetsc.solve.linear.system import assembly_bytes
from msmpetsc.solve.linear.unknowns import BYTES_OF_NODE
from msmpetsc.study.cases import Case, digest, inline
from msmpetsc.study.process import Processes
from msmpetsc.study.runner import Bench
from msmpetsc.study.table import Row

COARSE, FINE = 1000, 20_000  # cells of the two runs, at most
LONGEST = 300.0  # [s] a run
POSITION = 24  # bytes of three doubles
BYTES_OF_POINT = 14 * 64 * 8  # of the surface, while W is made of up to 64 weights each; as seen with "affine"
STEEPEST = 1 / 3  # power of the cells that its may grow with: the cells along a side, as with Jacobi
EXTRA_WORK = 5  # w: a gradient, a Hessian, two or more energies, sums over vectors
# Of one step, counted in solve.nonlinear.step and PETSc's CG: exchanges of ghosts and sums over all ranks
EXCHANGES_OF_ITS, EXCHANGES_OF_ITERATION = 1, 4
SUMS_OF_ITS, SUMS_OF_ITERATION = 3, 10


class Network(NamedTuple):
    """latency [s] of a message, bandwidth [byte/s] of a rank."""

    latency: float
    bandwidth: float


@dataclass(frozen=True)
class ShortRun:
    """A short run on one rank; iterations and its are means a step."""

    cells: float
    nodes: float
    springs: float
    nonzeros: float
    memory: float  # [byte]
    time: float  # [s] of a step
    iterations: float
    its: float

    @classmethod
    def of(cls, row: Row) -> "ShortRun":
        """Return the run of a row of a study."""
        return cls(
            cells=row["cells"], nodes=row["nodes"], springs=row["springs"],
            nonzeros=row["unknowns"] + 2 * row["springs"], memory=row["memory"], time=row["time_frame"],
            iterations=row["iterations"], its=row["ksp_its"],
        )  # fmt: skip

    @property
    def unit(self) -> float:
        """Time of a KSP iteration [s]."""
        return self.time / units(self.its, self.iterations)

    @property
    def held(self) -> float:
        """Bytes of arrays while A is assembled."""
        return float(held(self.cells, self.nodes, self.springs, self.nonzeros))


def units(its: float, iterations: float) -> float:
    """Return the number of KSP iterations that a step is worth."""
    return its + EXTRA_WORK * (iterations + 1)


Count = float | np.ndarray  # of all, or (R,) of each rank


def held(cells: Count, nodes: Count, springs: Count, nonzeros: Count) -> Count:
    """Return the bytes of arrays that a rank has while A is assembled; numbers, or arrays of a number a rank."""
    unknowns = nodes * sum(BYTES_OF_NODE.values())
    return lattice_bytes(cells, nodes, springs) + unknowns + assembly_bytes(nodes, springs, nonzeros)


@dataclass(frozen=True)
class Forecast:
    """Laws of memory and time through a run on a coarse and a run on a fine lattice."""

    coarse: ShortRun
    fine: ShortRun

    @property
    def program(self) -> float:
        """Memory of a rank without arrays [byte]."""
        return max(0.0, self.coarse.memory - self._memory_of_byte * self.coarse.held)

    @property
    def _memory_of_byte(self) -> float:
        return max(0.0, _slope((self.coarse.held, self.coarse.memory), (self.fine.held, self.fine.memory)))

    def memory(self, partition: Partition, points: int = 0, mesh: float = 0.0) -> np.ndarray:
        """Return the memory (R,) of each rank [byte].

        points : of the surface, where it is stored
        mesh   : bytes that the surface needs on rank 0 while it is prepared
        """
        arrays = held(partition.cells, partition.nodes + partition.ghosts, partition.springs, partition.nonzeros)
        needed = np.maximum(self._memory_of_byte * arrays, BYTES_OF_POINT * points / partition.ranks)
        needed[0] = max(needed[0], mesh)
        return self.program + needed

    def its(self, cells: float) -> float:
        """Return the KSP iterations of a step of so many cells."""
        return self._grown("its", cells)

    def iterations(self, cells: float) -> float:
        """Return the outer iterations; where nothing is solved, substeps, which grow as the cells along a side do."""
        return self.fine.iterations if self.fine.its else self._grown("iterations", cells)

    def _grown(self, name: str, cells: float) -> float:
        """Return a number of a run, grown as the power of the cells that goes through the two runs."""
        coarse, fine = getattr(self.coarse, name), getattr(self.fine, name)
        if not min(coarse, fine) > 0 or self.fine.cells <= self.coarse.cells:
            return fine
        power = math.log(fine / coarse) / math.log(self.fine.cells / self.coarse.cells)
        return fine * (cells / self.fine.cells) ** min(max(power, 0.0), STEEPEST)

    def computing(self, partition: Partition) -> float:
        """Return the computing time of a step [s], on the rank that has most springs."""
        coarse, fine = self.coarse, self.fine
        unit = _line(partition.springs.max(), (coarse.springs, coarse.unit), (fine.springs, fine.unit))
        cells = partition.cells.sum()
        return units(self.its(cells), self.iterations(cells)) * unit

    def messages(self, partition: Partition, network: Network) -> float:
        """Return the time of a step's messages [s], on the rank whose ghosts take longest."""
        cells = partition.cells.sum()
        its, iterations = self.its(cells), self.iterations(cells) + 1
        exchange = (partition.neighbours * network.latency + partition.ghosts * POSITION / network.bandwidth).max()
        total = 2 * math.ceil(math.log2(partition.ranks)) * network.latency  # a sum: up and down a tree
        exchanges = EXCHANGES_OF_ITS * its + EXCHANGES_OF_ITERATION * iterations
        return exchanges * exchange + (SUMS_OF_ITS * its + SUMS_OF_ITERATION * iterations) * total


def _slope(a: tuple[float, float], b: tuple[float, float]) -> float:
    (x0, y0), (x1, y1) = a, b
    return (y1 - y0) / (x1 - x0) if x1 > x0 else 0.0


def _line(x: float, a: tuple[float, float], b: tuple[float, float]) -> float:
    """Return y at x, on the line through two points; never falling with x, nor below zero at none."""
    x1, y1 = b
    slope = min(max(_slope(a, b), 0.0), y1 / x1)
    return y1 + slope * (x - x1)


def forecast(
    *,
    file: Path,
    changes: Sequence[str],
    options: str,
    scene: Scene,
    surfaces: Sequence[Surface],
    cells: float,
    frames: int,
    again: bool,
) -> Forecast:
    """Return the forecast from two runs of the first ``frames`` steps of a scene of so many ``cells``.

    Runs that were made on this machine before stand in the user's cache, unless they are to be made ``again``.

    surfaces : prepared, of each body

    Raises InputError where a run fails.
    """
    cached = _cache_file(file, options, scene, frames)
    if cached.is_file() and not again:
        rows = json.loads(cached.read_text())
    else:
        fine = min(int(cells), FINE)
        with tempfile.TemporaryDirectory(prefix="msmpetsc-inspect-") as folder:
            meshes = [Path(folder) / f"surface{number}.obj" for number in range(len(surfaces))]
            for surface, mesh in zip(surfaces, meshes, strict=True):
                trimesh.Trimesh(surface.points, surface.triangles, process=False).export(mesh)
            base = _case(file, scene, changes=changes, options=options, meshes=meshes, frames=frames)
            rows = _measured(Path(folder), [_on(base, scene, n) for n in (min(COARSE, max(1, fine // 8)), fine)])
        with suppress(InputError):  # a full disk, a home that cannot be written: it is a cache
            write_whole(cached, json.dumps(rows))
    return Forecast(*map(ShortRun.of, rows))


def _cache_file(file: Path, options: str, scene: Scene, frames: int) -> Path:
    """Return where the figures of these runs on this processor are kept."""
    what = [digest(file, scene), scene.text, options, frames, __version__, processor(), COARSE, FINE]
    name = hashlib.sha256(json.dumps(what).encode()).hexdigest()[:16]
    return Path(pooch.os_cache("msmpetsc")) / "trials" / f"{name}.json"


def _measured(folder: Path, cases: Sequence[Case]) -> list[Row]:
    """Return the rows of the runs."""
    processes = Processes()
    bench, rows = Bench(folder, processes), []
    try:
        for case in cases:
            rows.append(bench.measure(case).row)
            if rows[-1]["status"] != "ok":
                reason = rows[-1]["reason"]
                raise InputError(f"the short run on {case.cells} cells that times are taken from: {reason}")
    finally:
        processes.stop()
    return rows


def _case(
    file: Path, scene: Scene, *, changes: Sequence[str], options: str, meshes: Sequence[Path], frames: int
) -> Case:
    """Return the run of the scene's first frames, its surfaces as they were prepared."""
    time = scene.time
    prepared = dict(zip((".".join(map(str, path)) for path in scene.meshes), meshes, strict=True))
    all_changes = (
        *changes, *(f"{key}={inline({'source': str(mesh)})}" for key, mesh in prepared.items()),
        f"time.duration={min(frames, time.steps) * time.step!r}",
        "output.surface=false", "output.every=1",
    )  # fmt: skip
    return Case(
        scene=scene.title or file.stem, file=file, content="", set=all_changes, integrator=time.integrator,
        options=options, time_step=time.step, timeout=LONGEST,
    )  # fmt: skip


def _on(case: Case, scene: Scene, cells: int) -> Case:
    """Return a run on so many cells."""
    cages = scene.cages.model_dump(exclude_unset=True, exclude={"cell_size", "max_cells"}) | {"count": cells}
    return replace(case, cells=cells).changed(f"cages={inline(cages)}")
