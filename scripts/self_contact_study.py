#!/usr/bin/env python3
"""Runs scenes whose surface meets itself, and prints Markdown tables: does it cross, what it costs. Needs the meshes.

    scripts/self_contact_study.py [SCENE...] [--cells N] [--frames N] [--shorter N] [--set KEY=VALUE]
                                  [--points 5000,20000,50000]

Of each scene that touches: contacts, least distance, iterations and what a frame costs. crossings: pairs of an edge and
a triangle that cross, over all frames, by a test that shares nothing with the contact's own, of the surface that meets
itself; of the one that is drawn over 20. --shorter 16 takes steps, and frames, of a sixteenth.

Then CPU time of a step without self-contact and with it, by points of the surface that meets itself, and what its
parts take: bunny and brain in free fall, an armadillo whose leg is dragged, by five edges of 5,000 points a step at
first, and the lung while it is pressed. A surface has no more points than its mesh.
"""

import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from itertools import chain
from pathlib import Path
from time import process_time
from typing import Any

from clone import ROOT, parser

import numpy as np
from mpi4py import MPI

from msmpetsc.model.build import build_model
from msmpetsc.model.self_contact.barrier import Barrier
from msmpetsc.model.self_contact.contacts import CollisionSurface
from msmpetsc.model.self_contact.points import SurfacePoints
from msmpetsc.model.self_contact.term import SurfaceHessian
from msmpetsc.output.reader import Result
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.simulate import Simulation

sys.path.insert(0, str(ROOT / "tests" / "helpers"))
from crossings import count_crossings

SCENES, OUT = ROOT / "scenes", ROOT / "out" / "self_contact_study"
TOUCHING = ("two_bunnies", "pile", "armadillo_fold", "lung_press_contact")
FALLING = ("bunny_fall", "brain_fall")
COSTS = {
    "bunny_fall": (2, 32),
    "brain_fall": (2, 32),
    "armadillo_leg": (2, 12),
    "lung_press": (20, 60),
}  # steps
PARTS: dict[str, list[tuple[Any, str]]] = {  # of self-contact
    "points": [(SurfacePoints, "__call__")],
    "pairs": [(Barrier, "candidates"), (Barrier, "clear_reach")],
    "contacts": [(Barrier, "contacts"), (Barrier, "least")],
    "ways": [(Barrier, "free_share"), (Barrier, "sweep"), (Barrier, "free_share_in_creases")],
    "barrier": [(Barrier, "energy"), (Barrier, "gradient"), (Barrier, "hessian")],
    "products": [(SurfaceHessian, "add_product")],
}
COUNTED = 20  # frames whose crossings of the surface that is drawn are counted


def run(scene: str, name: str, options: list[str], *more: object) -> Path:
    """Run a scene with these keys changed; the path of the result."""
    path = OUT / f"{name}.h5"
    changes = [word for option in options for word in ("--set", option)]
    command = [sys.executable, "-m", "msmpetsc", "run", SCENES / f"{scene}.toml", "-o", path, "--overwrite", "--quiet"]
    subprocess.run([str(word) for word in [*command, *changes, *more]], check=False)  # its frames count if it fails
    return path


def touching(scene: str, changes: list[str], cells: int | None, steps: int | None, shorter: int) -> list[str]:
    """Row of a scene that touches itself."""
    options = [*changes, *([f"cages.count={cells}"] if cells else [])]
    if shorter > 1:
        step = load_scene(SCENES / f"{scene}.toml").time.step
        options.append(f"time.step={step / shorter!r}")
    path = run(scene, scene, options, *(["--frames", steps] if steps else []))
    model = build_model(MPI.COMM_SELF, load_scene(SCENES / f"{scene}.toml", options))
    assert isinstance(model.collision, CollisionSurface) and model.collision.surface and model.surface
    points, triangles = model.collision.points, model.collision.surface.triangles
    with Result(path) as result:
        frames, last = result.frames, len(result.frames.time[:]) - 1
        counted = [frames.position[int(i)] for i in np.linspace(0, last, COUNTED).round()]
        met = sum(count_crossings(points(frames.position[index]), triangles) for index in range(last + 1))
        drawn = sum(count_crossings(result.embedding @ q, model.surface.triangles) for q in counted)
        least, law = np.nanmin(frames.self_distance[:]), model.collision.law
        costs = [frames.iterations[1:].mean(), frames.products[1:].mean(), 1e3 * frames.wall_time[1:].mean()]
        sizes = [len(model.lattice.cells), len(triangles), last, frames.self_contacts[:].max()]
    words = [*(f"{size:,}" for size in sizes), f"{1e6 * least:.2g} of {1e6 * law.distance:.0f}", f"{met}", f"{drawn}"]
    return [f"`{scene}`", *words, f"{costs[0]:.1f}", f"{costs[1]:,.0f}", f"{costs[2]:,.0f}"]


@contextmanager
def timed(seconds: dict[str, float]) -> Iterator[None]:
    """Add the CPU time within each part's methods to ``seconds``; of one within another it counts to the outer."""
    kept: dict[tuple[Any, str], Callable] = {}
    depth = [0]

    def wrap(part: str, method: Callable) -> Callable:
        @wraps(method)
        def call(*arguments: Any, **more: Any) -> Any:
            depth[0] += 1
            begin = process_time()
            try:
                return method(*arguments, **more)
            finally:
                depth[0] -= 1
                if not depth[0]:
                    seconds[part] += process_time() - begin

        return call

    for part, methods in PARTS.items():
        for kind, name in methods:
            kept[kind, name] = getattr(kind, name)
            setattr(kind, name, wrap(part, kept[kind, name]))
    try:
        yield
    finally:
        for (kind, name), method in kept.items():
            setattr(kind, name, method)


def stepped(scene: str, changes: list[str]) -> tuple[float, dict[str, float], int]:
    """CPU seconds of a step, those of each part of self-contact in it, and the points of the surface that meets."""
    first, last = COSTS[scene]
    given = load_scene(SCENES / f"{scene}.toml", ["output.surface=false", *changes])
    model = build_model(MPI.COMM_SELF, given)
    seconds, begin = dict.fromkeys(PARTS, 0.0), 0.0
    with timed(seconds), Simulation(MPI.COMM_SELF, given, model) as simulation:
        for frame in simulation.frames():
            if frame.index == first:
                begin = process_time()
                seconds.update(dict.fromkeys(PARTS, 0.0))
            if frame.index == last:
                break
        whole = process_time() - begin
    points = model.collision.points.total if model.collision else 0
    return whole / (last - first), {part: value / (last - first) for part, value in seconds.items()}, points


def cost(scene: str, points: list[int], cells: int | None) -> Iterator[list[str]]:
    """Rows of a scene: milliseconds of a step without self-contact, and with so many points."""
    changes = [f"cages.count={cells}"] if cells else []
    changes += ['obstacle.0.response="penalty"'] if scene in FALLING else []
    without = stepped(scene, changes)[0]
    yield [f"`{scene}`", "-", f"{1e3 * without:.0f}", "", *[""] * len(PARTS)]
    had = 0
    for count in points:
        before, (whole, seconds, had) = had, stepped(scene, [*changes, f"self_contact.surface={2 * count}"])
        if had == before:
            return
        parts = [f"{1e3 * seconds[part]:.1f}" for part in PARTS]
        yield [f"`{scene}`", f"{had:,}", f"{1e3 * whole:.0f}", f"{whole / without:.2f}", *parts]


def table(head: list[str], rows: Iterable[list[str]]) -> None:
    for row in chain((head, ["---"] * len(head)), rows):
        print(f"| {' | '.join(row)} |", flush=True)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("scenes", nargs="*", metavar="SCENE", help=f"of {', '.join((*TOUCHING, *COSTS))}; all if none")
    options.add_argument("--cells", type=int, metavar="N", help="of each scene; its own if absent")
    options.add_argument("--frames", type=int, metavar="N", help="of those that touch; all if absent")
    options.add_argument("--shorter", type=int, default=1, metavar="N", help="times, the steps of those that touch")
    options.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of those that touch")
    options.add_argument("--points", default="5000,20000,50000", metavar="N,N", help="of the surface (%(default)s)")
    args = options.parse_args()
    unknown = set(args.scenes) - {*TOUCHING, *COSTS}
    if unknown:
        options.error(f"no scene {', '.join(sorted(unknown))}: {', '.join((*TOUCHING, *COSTS))}")
    OUT.mkdir(parents=True, exist_ok=True)
    chosen, points = args.scenes or (*TOUCHING, *COSTS), [int(count) for count in args.points.split(",")]
    head = ["scene", "cells", "triangles", "steps", "contacts at most", "least distance [µm]"]
    head += ["crossed", "drawn", "iterations a step", "products", "ms a frame"]
    if met := [scene for scene in TOUCHING if scene in chosen]:
        table(head, (touching(scene, args.set, args.cells, args.frames, args.shorter) for scene in met))
        print()
    if costs := [scene for scene in COSTS if scene in chosen]:
        head = ["scene", "points", "ms a step", "times as long", *(f"{part} [ms]" for part in PARTS)]
        table(head, (row for scene in costs for row in cost(scene, points, args.cells)))


if __name__ == "__main__":
    main()
