#!/usr/bin/env python3
"""A GPU beside the CPU of the same machine: prints Markdown and leaves out/bench_gpu/figures.json.

    scripts/bench_gpu.py [--cells N ...] [--scenes NAME ...] [--frames N] [--error E]

Runs: every scene of the paper and beam_soft at each number of cells, by `msmpetsc run` on one core, on all cores and
on the GPU; frames a second are those of the steps alone, the median of all frames but the first two, in which kernels
are compiled, beside the largest step error reported and how far the GPU's last frame is from the CPU's.
Parts: for beam_soft at each number of cells, in this process, what an iteration of CG consists of, beside what the
memory allows: the bytes that cannot be spared over the bandwidth that a copy reaches. Then how many launches a frame
takes and what a launch costs, alone and in a CUDA graph, and what is carried between CPU and GPU. Where memory allows,
--cells 10000000 may be among the sizes.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from time import perf_counter

from clone import ROOT, parser

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.app.profile import machine, versions
from msmpetsc.backend import arrays, cuda
from msmpetsc.backend.kernel import kernel
from msmpetsc.model.build import Model, build_model, to_device
from msmpetsc.model.elasticity.springs import SpringGather
from msmpetsc.output.reader import Result
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.linear.operators import ThreeColumns
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.petsc import device
from msmpetsc.solve.presets import find_preset
from msmpetsc.solve.simulate import Simulation

ARMADILLOS = ("armadillo_leg", "armadillo_palm", "armadillo_forehead")
SCENES = (*ARMADILLOS, "dragon_raise_push", "lung_press", "heart_pull", "brain_fall")
SIZES = 10_000, 100_000, 1_000_000
BEAM = "studies/beam_soft"  # which swings: a body that falls freely has nothing to solve
COMPILING = 2  # frames
REPEATS = 30
ITERATIONS = 100  # of CG
VECTORS = 19  # vectors of 3 m numbers that an iteration of CG reads or writes at least, A's product among them
SPRING, NODE = 4 + 1 + 8, 8  # [byte] of a neighbour: its number, the kind and the stiffness of the spring; of a mass


# ---- runs


def cell_size(cells: int) -> str:
    """The setting by which the beam, 40 x 16 x 16 cells as it is shipped, has about so many."""
    along = 5 * round(8 * (cells / 10240) ** (1 / 3))
    return f"cages.cell_size={1.25 / along!r}"


def run(scene: str, overrides: list[str], where: str, folder: Path, args: argparse.Namespace) -> Path | None:
    """The result of a scene; None if it failed."""
    name = "_".join([Path(scene).name, *(o.rpartition("=")[2] for o in overrides), where.replace(" ", "")])
    ranks = ["mpiexec", "-n", str(args.cores)] if where == "all cores" else []
    command = [*ranks, sys.executable, "-m", "msmpetsc", "run", str(ROOT / "scenes" / f"{scene}.toml")]
    command += [
        "-o",
        str(folder / f"{name}.h5"),
        "--overwrite",
        "--error",
        str(args.error),
        "--frames",
        str(args.frames),
    ]
    command += [word for override in overrides for word in ("--set", override)]
    command += ["--device", "cuda" if where == "GPU" else "cpu"]
    print("running", name, file=sys.stderr)
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.strip("-")]  # mpiexec rules lines
        print(said[-1] if said else f"status {done.returncode}", file=sys.stderr)
        return None
    return folder / f"{name}.h5"


def figures(path: Path) -> dict:
    """Cells, frames a second, the largest error, and the last positions and how far the body is long."""
    with Result(path) as result:
        frames = result.frames
        seconds = frames.wall_time[1:][COMPILING:]
        last, extent = frames.position[-1], np.ptp(result.lattice.nodes[:], axis=0).max()
        error, cells = frames.step_error[1:].max(), len(result.lattice.cells)
        its = frames.ksp_its[1:][COMPILING:].mean()
    return {
        "cells": cells,
        "speed": float(1 / np.median(seconds)),
        "its": float(its),
        "error": float(error),
        "last": last,
        "extent": extent,
    }


def compared(args: argparse.Namespace, folder: Path) -> Iterator[dict]:
    """One row for each scene and size."""
    cases: list[tuple[str, list[str]]] = [(scene, []) for scene in args.scenes] + [
        (BEAM, [cell_size(n)]) for n in args.cells
    ]
    for scene, overrides in cases:
        found = {}
        for where in ("one core", "all cores", "GPU"):
            if where != "all cores" or args.cores > 1:
                path = run(scene, overrides, where, folder, args)
                found[where] = figures(path) if path else None
        known = [one for one in found.values() if one]
        row = {"scene": scene, "cells": known[0]["cells"] if known else None}
        row |= {f"frames/s, {where}": one and one["speed"] for where, one in found.items()}
        row["CG iterations a frame"] = known[0]["its"] if known else None
        row["error"] = max(one["error"] for one in known) if known else None
        if found["one core"] and found["GPU"]:
            apart = np.abs(found["GPU"]["last"] - found["one core"]["last"]).max()
            row["GPU / core"] = found["GPU"]["speed"] / found["one core"]["speed"]
            row["apart"] = float(apart / found["one core"]["extent"])
        yield row


# ---- parts


@kernel
def laplacian_around(first, count, step, v, other, stiffness, product):
    """L v by a kernel of our own: what cuSPARSE's product with a block of three columns is held against."""
    for i in range(first, count, step):
        x, y, z = 0.0, 0.0, 0.0
        for s in range(other.shape[0]):
            j = other[s, i]
            if j < 0:
                break
            k = stiffness[s, i]
            x += k * (v[i, 0] - v[j, 0])
            y += k * (v[i, 1] - v[j, 1])
            z += k * (v[i, 2] - v[j, 2])
        product[i, 0], product[i, 1], product[i, 2] = x, y, z


@kernel
def nothing(first, count, step, array, a, b, c, d, x, y, z):
    """With about as many arguments as others have, for each takes its time."""
    for i in range(first, count, step):
        if array[i] < x + y + z:
            array[i] = a[i] + b[i] + c[i] + d[i]


def seconds_of(function: Callable[[], object], repeats: int = REPEATS) -> float:
    """The mean of some calls one after another, the device done with the last; after two that compile."""
    for _ in range(2):
        function()
    cuda.wait()
    begin = perf_counter()
    for _ in range(repeats):
        function()
    cuda.wait()
    return (perf_counter() - begin) / repeats


def bandwidth(like: np.ndarray) -> float:
    """[byte/s] read and written by a copy of half a gigabyte."""
    source = np.zeros(2**26, like=like)
    target = np.zeros_like(source)
    return 2 * 8 * 2**26 / seconds_of(lambda: np.copyto(target, source))


def parts(model: Model, time_step: float) -> dict[str, float]:
    """Seconds of what steps consist of, and the least that an iteration of CG could take."""
    stepper = Stepper(MPI.COMM_SELF, model.lattice, time_step, find_preset("newton"))
    stepper.set_up()
    q = model.lattice.nodes * 1.01  # stretched, so that the Hessian is positive
    stepper.functional.begin(StepProblem(q, q, np.zeros((model.lattice.owned, 3), like=q)))
    stepper.jacobian.hessian.linearise(q, None)
    stepper.jacobian.operator.assemble()
    three = ThreeColumns(stepper.jacobian.matrix, stepper.unknowns)
    x, y, elasticity = stepper.x, stepper.work, stepper.functional.elasticity
    stepper.unknowns.from_nodes(np.sin(40 * q), x)
    pc, gradient = stepper.ksp.getPC(), np.zeros_like(q)
    found = {
        "gradient": seconds_of(lambda: elasticity.add_gradient(q, gradient)),
        "change of energy": seconds_of(lambda: elasticity.change(q, q)),
        "Hessian product": seconds_of(lambda: stepper.jacobian.operator.mult(x, y)),
        "A, by PETSc": seconds_of(lambda: three.mult(None, x, y)),
        "preconditioner": seconds_of(lambda: pc.apply(x, y)),
        "CG iteration": iteration(stepper),
        "bound of one": bound(model) / bandwidth(q),
    }
    if not arrays.on_host(q):
        around = elasticity.springs
        assert isinstance(around, SpringGather)  # as on every GPU
        tables = around.neighbour, around.stiffness
        found["A, by a kernel"] = seconds_of(lambda: laplacian_around(len(q), q, *tables, gradient))
        product = stepper.jacobian.hessian.mult
        found["Hessian product in a graph"] = in_a_graph(lambda: product(None, x, y))
    three.destroy(None)
    stepper.destroy()
    return found


def bound(model: Model) -> float:
    """[byte] that an iteration of CG has to move: the springs around each node, masses, and CG's vectors."""
    lattice = model.lattice
    return 2 * len(lattice.springs) * SPRING + lattice.owned * (NODE + VECTORS * 3 * 8)


def iteration(stepper: Stepper) -> float:
    """[s] of CG's, which is kept from ending."""
    ksp = stepper.ksp
    ksp.setTolerances(rtol=1e-300, atol=1e-300, max_it=ITERATIONS)
    right = stepper.x.duplicate()
    stepper.x.copy(right)
    found = seconds_of(lambda: ksp.solve(right, stepper.work), 3)
    its = ksp.getIterationNumber()
    right.destroy()
    return found / its


def in_a_graph(function: Callable[[], object], times: int = 1) -> float:
    """[s] of what is launched in it, recorded as a CUDA graph of so many times that; NaN where it cannot be."""
    import cupy

    stream = cupy.cuda.Stream(non_blocking=True)
    function()  # compiles
    cuda.wait()
    try:
        with stream:
            stream.begin_capture()
            for _ in range(times):
                function()
            graph = stream.end_capture()
            return seconds_of(lambda: graph.launch(stream)) / times
    except RuntimeError as error:  # CuPy's of the CUDA runtime
        print("no CUDA graph:", error, file=sys.stderr)
        return np.nan


def launches(positions: np.ndarray) -> dict[str, float]:
    """[s] that one takes when many follow each other, alone and in a CUDA graph; and to bring positions to the CPU."""
    array = np.zeros(1000, like=positions)

    def launch() -> None:
        nothing(len(array), *[array] * 5, 0.0, 0, False)

    alone, transfer = seconds_of(launch, 1000), seconds_of(lambda: arrays.to_host(positions))
    return {"a launch": alone, "a launch in a graph": in_a_graph(launch, 100), "a transfer": transfer}


@contextmanager
def counting() -> Iterator[dict]:
    """How many kernels of ours are launched, and how often and how much is carried, while this lasts."""
    from msmpetsc.backend import launcher as launching

    told = {"launches": 0, "to the CPU": 0, "bytes to the CPU": 0, "to the GPU": 0, "bytes to the GPU": 0}
    launcher, to_host, like = launching.launcher, arrays.to_host, arrays.like

    def counted_launcher(body):
        launch = launcher(body)

        def counted(*arguments):
            told["launches"] += 1
            launch(*arguments)

        return counted

    def counted_to_host(array):
        if not arrays.on_host(array):
            told["to the CPU"] += 1
            told["bytes to the CPU"] += array.nbytes
        return to_host(array)

    def counted_like(array, values):
        if arrays.on_host(values) and not arrays.on_host(array):
            told["to the GPU"] += 1
            told["bytes to the GPU"] += values.nbytes
        return like(array, values)

    ours = [module for name, module in sys.modules.items() if name.startswith("msmpetsc.")]
    counted = {
        "launcher": (launcher, counted_launcher),
        "to_host": (to_host, counted_to_host),
        "like": (like, counted_like),
    }
    places = [(m, name, *pair) for m in ours for name, pair in counted.items() if vars(m).get(name) is pair[0]]
    for module, name, _, replacement in places:
        setattr(module, name, replacement)
    try:
        yield told
    finally:
        for module, name, before, _ in places:
            setattr(module, name, before)


def a_frame(scene, model: Model, frames: int) -> dict[str, float]:
    """Of the mean frame after the first: seconds, CG iterations, launches, what was carried."""
    with Simulation(MPI.COMM_SELF, scene, model) as simulation:
        stream = simulation.frames()
        for _ in range(1 + COMPILING):
            next(stream)
        cuda.wait()
        with counting() as told:
            begin = perf_counter()
            its = [frame.ksp_its for frame in islice(stream, frames)]
            cuda.wait()
            took = perf_counter() - begin
    return {name: value / len(its) for name, value in {"seconds": took, "CG iterations": sum(its), **told}.items()}


def dissected(cells: int, args: argparse.Namespace) -> dict:
    """The parts of beam_soft at a number of cells, on the CPU and on the GPU."""
    print("parts at", cells, "cells", file=sys.stderr)
    scene = load_scene(ROOT / "scenes" / f"{BEAM}.toml", [cell_size(cells)])
    model = build_model(MPI.COMM_SELF, scene)
    found = {"cells": len(model.lattice.cells), "CPU": parts(model, scene.time.step)}
    device.choose(MPI.COMM_SELF, "cuda")
    there = to_device(model, device.sender(MPI.COMM_SELF))
    found["GPU"] = parts(there, scene.time.step)
    found["a frame"] = a_frame(scene, model, args.frames) | launches(there.lattice.nodes)
    PETSc.Options().delValue(device.OPTION)
    return found


# ---- what is printed


def shown(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    return "" if value is None else f"{value:,}" if isinstance(value, int) else str(value)


def print_table(rows: list[dict]) -> None:
    names = list(dict.fromkeys(name for row in rows for name in row))
    print("\n|", " | ".join(names), "|\n" + "|---" * len(names) + "|")
    for row in rows:
        print("|", " | ".join(shown(row.get(name)) for name in names), "|")


def print_parts(found: dict) -> None:
    """Milliseconds; an iteration also as a share of what the memory allows."""
    print(f"\n{found['cells']:,} cells, milliseconds:")
    names = list(found["GPU"])
    print_table(
        [{"": where} | {name: 1e3 * found[where].get(name, np.nan) for name in names} for where in ("CPU", "GPU")]
    )
    for where in ("CPU", "GPU"):
        share = found[where]["bound of one"] / found[where]["CG iteration"]
        print(f"{where}: an iteration of CG at {share:.0%} of what the memory's bandwidth allows")
    frame = found["a frame"]
    share = frame["launches"] * frame["a launch"] / frame["seconds"]
    print(f"A frame: {1 / frame['seconds']:.3g} a second with {frame['CG iterations']:.0f} CG iterations; our", end=" ")
    print(f"{frame['launches']:.0f} launches at {1e6 * frame['a launch']:.3g} us take {share:.0%} of it", end=" ")
    print(
        f"({1e6 * frame['a launch in a graph']:.3g} us each in a CUDA graph), and bringing the positions to the",
        end=" ",
    )
    print(f"CPU {frame['a transfer'] / frame['seconds']:.0%}; arrays carried to the CPU", end=" ")
    print(f"{frame['to the CPU']:.3g} times, {frame['bytes to the CPU']:.3g} bytes, to the GPU", end=" ")
    print(f"{frame['to the GPU']:.3g} times, {frame['bytes to the GPU']:.3g} bytes")


def main() -> int:
    options = parser(__doc__)
    options.add_argument("--scenes", nargs="*", default=SCENES, metavar="NAME", help="scenes to run")
    options.add_argument("--cells", nargs="*", type=int, default=SIZES, metavar="N", help="sizes of beam_soft")
    options.add_argument(
        "--frames", type=int, default=20, metavar="N", help="of each run, and of the frames looked into"
    )
    options.add_argument("--error", type=float, default=1e-3, metavar="E", help="of each step, relative")
    options.add_argument("--cores", type=int, default=os.cpu_count(), metavar="N", help="of 'all cores'")
    args = options.parse_args()
    lacking = device.what_is_missing()
    if lacking:
        print(f"bench_gpu: {lacking}", file=sys.stderr)
        return 2
    folder = ROOT / "out" / "bench_gpu"
    folder.mkdir(parents=True, exist_ok=True)
    host = machine() | {"gpu": cuda.name()}
    parts: list[dict] = []
    told: dict = {"machine": host, "versions": versions(), "options": vars(args), "parts": parts}
    print(f"{host['gpu']} beside {host['cpu']}, {args.cores} cores; PETSc {versions()['petsc']}")
    for cells in args.cells:
        parts.append(dissected(cells, args))
        print_parts(parts[-1])
        (folder / "figures.json").write_text(json.dumps(told, indent=1))
    told["runs"] = list(compared(args, folder))
    print_table(told["runs"])
    (folder / "figures.json").write_text(json.dumps(told, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
