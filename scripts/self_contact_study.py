#!/usr/bin/env python3
"""Scenes whose surface meets itself: does it cross, and what a frame costs. Needs the meshes.

    scripts/self_contact_study.py [SCENE...] [--frames N] [--shorter N] [--set KEY=VALUE] [-o PAGE]

crossed: pairs of an edge and a triangle that cross, over all frames, by a test that shares nothing with the contact's
own, of the surface that meets itself; drawn: of the one that is drawn, over 20 frames. --shorter 16 takes steps, and
frames, of a sixteenth. What contact adds to a step by the points of the surface, scenes/studies/contact.toml measures.
"""

import argparse
import sys

import lab
from clone import ROOT

import numpy as np
from mpi4py import MPI

from msmpetsc.build import build_model
from msmpetsc.contact.surface.pairs import CollisionSurface
from msmpetsc.results.reader import Result
from msmpetsc.scene.reading import load_scene

sys.path.insert(0, str(ROOT / "tests" / "helpers"))
from crossings import count_crossings

TOUCHING = ("two_bunnies", "pile", "armadillo_fold", "lung_press_contact")
COUNTED = 20  # frames whose crossings of the surface that is drawn are counted


def touching(scene: str, args: argparse.Namespace) -> lab.Row:
    """Return the row of a scene that touches itself."""
    changes = [*args.set]
    file = lab.SCENES / f"{scene}.toml"
    if args.shorter > 1:
        changes.append(f"time.step={load_scene(file).time.step / args.shorter!r}")
    words = ["--quiet", *(["--frames", args.frames] if args.frames else [])]
    run = lab.run(scene, lab.OUT / "self_contact_study" / f"{scene}.h5", words, changes)  # its frames count if it fails
    model = build_model(MPI.COMM_SELF, load_scene(file, changes))
    assert isinstance(model.collision, CollisionSurface) and model.collision.surface and model.surface
    points, triangles = model.collision.points, model.collision.surface.triangles
    with Result(run.path) as result:
        position, last = result.frames.position, len(result.frames.time[:]) - 1
        counted = [position[index] for index in np.unique(np.linspace(0, last, COUNTED).round().astype(int))]
        met = sum(count_crossings(points(position[index]), triangles) for index in range(last + 1))
        drawn = sum(count_crossings(result.embedding @ q, model.surface.triangles) for q in counted)
        least, most = np.nanmin(result.frames.self_distance[:]), result.frames.self_contacts[:].max()
    frames = run.frames("iterations", "products", "wall_time")
    return {
        "scene": f"`{scene}`",
        "cells": len(model.lattice.cells),
        "triangles": len(triangles),
        "steps": last,
        "contacts at most": int(most),
        "least distance [µm]": f"{1e6 * least:.2g} of {1e6 * model.collision.law.distance:.0f}",
        "crossed": int(met),
        "drawn": int(drawn),
        "iterations a step": float(frames["iterations"].mean()),
        "products": float(frames["products"].mean()),
        "ms a frame": float(1e3 * frames["wall_time"].mean()),
    }


def main() -> None:
    options = lab.parser(__doc__)
    options.add_argument("scenes", nargs="*", metavar="SCENE", default=TOUCHING, help=", ".join(TOUCHING))
    options.add_argument("--frames", type=int, metavar="N", help="of each scene; all if absent")
    options.add_argument("--shorter", type=int, default=1, metavar="N", help="times, the steps")
    options.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="changes of every scene")
    args = options.parse_args()
    with lab.page(args):
        lab.table(touching(scene, args) for scene in args.scenes)


if __name__ == "__main__":
    main()
