#!/usr/bin/env python3
"""Scenes as tissue, neo-Hookean solids that all but keep their volume. Needs the meshes.

    scripts/tissue_study.py [SCENE...] [--nu 0.47] [--set KEY=VALUE] [-o PAGE]

Iterations and products are a frame's, in the mean. The volume is what the drawn surface encloses, against rest: the
most that is lost and gained in any frame, and at the end. "Inside out" is the most cells in any frame.
"""

import lab

import numpy as np
import trimesh

from msmpetsc.results.reader import Result

SCENES = ("bunny_fall", "heart_pull", "brain_fall")


def volumes(result: Result) -> np.ndarray:
    """Return the volume (frames,) within the surface, over that at rest, less 1."""
    triangles = result["surface/triangles"][:]
    shapes = (result["surface/points"][:], *result.frames.surface)
    found = np.array([trimesh.Trimesh(points, triangles, process=False).volume for points in shapes])
    return found[1:] / found[0] - 1


def row(scene: str, changes: list[str]) -> lab.Row:
    """Run a scene as tissue; its row of the table."""
    path = lab.OUT / "tissue" / f"{scene}.h5"
    with Result(lab.run(scene, path, changes=changes).path) as result:
        frames, change = result.frames, volumes(result)
        mean = {name: float(frames[name][1:].mean()) for name in ("iterations", "ksp_its", "products", "wall_time")}
        return {
            "scene": scene,
            "cells": len(result["lattice/cells"]),
            "frames": len(change) - 1,
            "frames a second": 1 / mean["wall_time"],
            "Newton's iterations": mean["iterations"],
            "of CG": mean["ksp_its"],
            "products": mean["products"],
            "inside out": int(frames.inverted[:].max()),
            "volume": ", ".join(lab.percent(value, 2) for value in (change.min(), change.max(), change[-1])),
        }


def main() -> None:
    options = lab.parser(__doc__)
    options.add_argument("scenes", nargs="*", metavar="SCENE", help=f"of scenes/; {', '.join(SCENES)} if none is named")
    options.add_argument("--nu", type=float, default=0.47, help="Poisson's ratio (0.47)")
    options.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a scene key")
    args = options.parse_args()
    changes = ["material.law=neo-hookean", f"material.poisson_ratio={args.nu}", "output.surface=true", *args.set]
    with lab.page(args):
        lab.table(row(scene, changes) for scene in args.scenes or SCENES)


if __name__ == "__main__":
    main()
