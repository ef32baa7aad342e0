#!/usr/bin/env python3
"""Runs scenes whose surface meets itself, and prints Markdown tables: does it cross, what it costs. Needs the meshes.

    scripts/self_contact_study.py [CELLS]     1500 if not given

crossings: pairs of an edge and a triangle of the surface that meets itself that cross, over all frames, by a test that
shares nothing with the contact's own. cost: seconds of the steps without and with self-contact, where nothing touches;
at full size.
"""

import subprocess
import sys
from pathlib import Path

from clone import ROOT, parser

import numpy as np
from mpi4py import MPI

from msmpetsc.model.build import build_model
from msmpetsc.output.reader import Result
from msmpetsc.scene.reading import load_scene

sys.path.insert(0, str(ROOT / "tests" / "helpers"))
from crossings import count_crossings

SCENES, OUT = ROOT / "scenes", ROOT / "out" / "self_contact_study"
TOUCHING = ("lung_press_contact",)
APART = {"armadillo_leg": (10, ()), "bunny_fall": (40, ('obstacle.0.response="penalty"',))}  # steps, what is changed
TRIANGLES = 10000  # half as many points


def run(scene: str, name: str, options: list[str], *more: object) -> Path:
    """Run a scene with these keys changed; the path of the result."""
    path = OUT / f"{name}.h5"
    changes = [word for option in options for word in ("--set", option)]
    command = [sys.executable, "-m", "msmpetsc", "run", SCENES / f"{scene}.toml", "-o", path, "--overwrite"]
    subprocess.run([str(word) for word in [*command, *changes, *more]], check=False)  # its frames count if it fails
    return path


def crossings(scene: str, cells: str) -> list[str]:
    """Row of a scene that touches itself."""
    options = [f"cages.count={cells}"]
    path = run(scene, scene, options)
    model = build_model(MPI.COMM_SELF, load_scene(SCENES / f"{scene}.toml", options))
    assert model.collision is not None and model.collision.surface is not None
    points, triangles = model.collision.points, model.collision.surface.triangles
    with Result(path) as result:
        frames = result.frames
        counts = [count_crossings(points(q), triangles) for q in frames.position]
        most, least, iterations = (
            frames.self_contacts[:].max(),
            np.nanmin(frames.self_distance[:]),
            frames.iterations[1:],
        )
    return [scene, f"{len(counts)}", f"{most}", f"{least:.2g}", f"{sum(counts)}", f"{iterations.mean():.1f}"]


def cost(scene: str) -> list[str]:
    """Row of a scene that does not."""
    steps, changes = APART[scene]
    seconds = []
    for more in ([], [f"self_contact.surface={TRIANGLES}"]):
        path = run(scene, f"{scene}_{len(more)}", [*changes, *more], "--frames", steps)
        with Result(path) as result:
            seconds.append(result.frames.wall_time[2:].sum() / (steps - 1))
    without, touching = seconds
    return [scene, f"{without:.3f}", f"{touching:.3f}", f"{100 * (touching / without - 1):+.0f}%"]


def table(head: list[str], rows: list[list[str]]) -> None:
    for row in (head, ["---"] * len(head), *rows):
        print(f"| {' | '.join(row)} |", flush=True)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("cells", nargs="?", default="1500")
    cells = options.parse_args().cells
    OUT.mkdir(parents=True, exist_ok=True)
    head = ["scene", "frames", "contacts at most", "least distance [m]", "crossings", "iterations a step"]
    table(head, [crossings(scene, cells) for scene in TOUCHING])
    print()
    table(["scene", "s a step without", "with", "more"], [cost(scene) for scene in APART])


if __name__ == "__main__":
    main()
