#!/usr/bin/env python3
"""Runs scenes whose surface meets itself, and prints Markdown tables: does it cross, what it costs. Needs the meshes.

    scripts/self_contact_study.py [SCENE...] [--cells N] [--frames N] [--shorter N] [--points 5000,20000,50000]

Of each scene that touches: contacts, least distance, iterations and what a frame costs. crossings: pairs of an edge and
a triangle that cross, over all frames, by a test that shares nothing with the contact's own, of the surface that meets
itself; of the one that is drawn over 20. --shorter 16 takes steps, and frames, of a sixteenth.

Then, where nothing touches, seconds of a step without self-contact and with it, by points of the surface that meets
itself: bunny and brain in free fall, an armadillo whose leg is dragged, by five edges of 5,000 points a step at first.
"-": the surface has fewer.
"""

import subprocess
import sys
from pathlib import Path

from clone import ROOT, parser

import numpy as np
from mpi4py import MPI

from msmpetsc.model.build import build_model
from msmpetsc.model.self_contact.contacts import CollisionSurface
from msmpetsc.output.reader import Result
from msmpetsc.scene.reading import load_scene

sys.path.insert(0, str(ROOT / "tests" / "helpers"))
from crossings import count_crossings

SCENES, OUT = ROOT / "scenes", ROOT / "out" / "self_contact_study"
TOUCHING = ("two_bunnies", "pile", "armadillo_fold", "lung_press_contact")
PRESSES = ('obstacle.0.response="penalty"',)
APART = {"bunny_fall": (20, PRESSES), "brain_fall": (20, PRESSES), "armadillo_leg": (10, ())}  # steps, what is changed
COUNTED = 20  # frames whose crossings of the surface that is drawn are counted


def run(scene: str, name: str, options: list[str], *more: object) -> Path:
    """Run a scene with these keys changed; the path of the result."""
    path = OUT / f"{name}.h5"
    changes = [word for option in options for word in ("--set", option)]
    command = [sys.executable, "-m", "msmpetsc", "run", SCENES / f"{scene}.toml", "-o", path, "--overwrite", "--quiet"]
    subprocess.run([str(word) for word in [*command, *changes, *more]], check=False)  # its frames count if it fails
    return path


def touching(scene: str, cells: int | None, steps: int | None, shorter: int) -> list[str]:
    """Row of a scene that touches itself."""
    options = [f"cages.count={cells}"] if cells else []
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


def cost(scene: str, points: list[int], cells: int | None) -> list[str]:
    """Row of a scene that does not: seconds of a step without, and with so many points."""
    steps, changes = APART[scene]
    most, seconds = np.inf, []
    for count in (0, *points):
        if count > 1.2 * most:
            continue
        more = [f"self_contact.surface={2 * count}"] if count else []
        more += [f"cages.count={cells}"] if cells else []
        path = run(scene, f"{scene}_{count}", [*changes, *more], "--frames", steps)
        with Result(path) as result:
            seconds.append(result.frames.wall_time[2:].mean())  # the first has the set-up
            most = len(result.surface.points[:])
    without, *others = seconds
    words = [f"{s:.3f} ({100 * (s / without - 1):+.0f}%)" for s in others]
    return [f"`{scene}`", f"{without:.3f}", *words, *["-"] * (len(points) - len(words))]


def table(head: list[str], rows: list[list[str]]) -> None:
    for row in (head, ["---"] * len(head), *rows):
        print(f"| {' | '.join(row)} |", flush=True)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("scenes", nargs="*", metavar="SCENE", help=f"of {', '.join((*TOUCHING, *APART))}; all if none")
    options.add_argument("--cells", type=int, metavar="N", help="of each scene; its own if absent")
    options.add_argument("--frames", type=int, metavar="N", help="of those that touch; all if absent")
    options.add_argument("--shorter", type=int, default=1, metavar="N", help="times, the steps of those that touch")
    options.add_argument("--points", default="5000,20000,50000", metavar="N,N", help="of the surface (%(default)s)")
    args = options.parse_args()
    unknown = set(args.scenes) - {*TOUCHING, *APART}
    if unknown:
        options.error(f"no scene {', '.join(sorted(unknown))}: {', '.join((*TOUCHING, *APART))}")
    OUT.mkdir(parents=True, exist_ok=True)
    chosen, points = args.scenes or (*TOUCHING, *APART), [int(count) for count in args.points.split(",")]
    head = ["scene", "cells", "triangles", "steps", "contacts at most", "least distance [µm]"]
    head += ["crossed", "drawn", "iterations a step", "products", "ms a frame"]
    if met := [scene for scene in TOUCHING if scene in chosen]:
        table(head, [touching(scene, args.cells, args.frames, args.shorter) for scene in met])
        print()
    if apart := [scene for scene in APART if scene in chosen]:
        head = ["scene", "s a step without", *(f"{count:,} points" for count in points)]
        table(head, [cost(scene, points, args.cells) for scene in apart])


if __name__ == "__main__":
    main()
