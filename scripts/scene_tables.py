#!/usr/bin/env python3
"""Print tables of the shipped scenes. Needs the meshes.

    scripts/scene_tables.py table1|tissue|touching [SCENE...] [--frames N] [--shorter N]
        [--set KEY=VALUE ...]

table1 is the paper's Table 1 with our figures, and the paper's in brackets. Each scene runs with
its springs, and as a neo-Hookean solid of the same Young's modulus and Poisson's ratio 1/4. Frames
a second are of the steps only: the mean, and the mean of the slowest tenth. Products with the
Hessian are per frame. The error is the largest relative step error that the runs report.

tissue runs neo-Hookean solids of Poisson's ratio 0.47. The volume within the drawn surface is given
relative to rest: the largest loss and gain of any frame, and the change at the end. "Inside out" is
the largest number of inverted cells of any frame.

touching runs scenes with self-contact; a SCENE may be a file. "Crossed" counts edges that cross
triangles of the collision surface in any frame, by a test independent of the contact code. "Drawn"
counts crossings of the drawn surface in 20 frames. CPU is the processor time of the steps with
contact, and without [self_contact]. --shorter 16 divides steps and frames by 16.
"""

import re
import shutil
import sys
from argparse import Namespace
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage

import lab
from clone import ROOT

import numpy as np
import trimesh
from mpi4py import MPI

from msmpetsc.build import build_model
from msmpetsc.contact.surface.pairs import CollisionSurface
from msmpetsc.results.reader import Result
from msmpetsc.scene.reading import load_scene

sys.path.insert(0, str(ROOT / "tests" / "helpers"))
from crossings import count_crossings

OUT = lab.OUT / "scene_tables"


def run(name: str, scene: str | Path, args: Namespace, *changes: str) -> Path:
    """Run a scene and return its result file; after a failure the frames before it count."""
    changes = (*changes, *args.set)
    file = lab.file_of(scene)
    if args.shorter > 1:
        changes += (f"time.step={load_scene(file).time.step / args.shorter!r}",)
    words = ["--quiet", *(["--frames", args.frames] if args.frames else [])]
    return lab.run(file, OUT / f"{name}_{file.stem}.h5", words, changes).path


def mean(result: Result, *names: str) -> dict[str, float]:
    """Return the means of columns over all frames but the first."""
    return {name: float(result.frames[name][1:].mean()) for name in names}


# ---- the paper's Table 1

# vertices, facets, valid cells, springs, frames per second on the CPU and on the GPU
PAPER = {
    "armadillo": (12602, 25200, 8338, 164343, 8.1, 30.0),
    "dragon": (23620, 47140, 11536, 232240, 5.5, 23.9),
    "lung": (43040, 86085, 6499, 127843, 10.1, 29.5),
    "heart": (43594, 108357, 3126, 62465, 19.9, 53.4),
    "bunny": (20667, 41330, 9946, 193589, 7.3, 30.1),
    "brain": (55024, 110047, 13661, 264481, 5.1, 20.0),
}
ARMADILLOS = ("armadillo_leg", "armadillo_palm", "armadillo_forehead")
SCENES = (*ARMADILLOS, "dragon_raise_push", "lung_press", "heart_pull", "bunny_fall", "brain_fall")
LAWS = {"springs": (), "neo-Hookean": ("material.law=neo-hookean",)}
ARRAYS = {
    "vertices": "surface/points", "facets": "surface/triangles", "valid cells": "lattice/cells",
    "springs": "lattice/springs",
}  # fmt: skip


def slowest_tenth(seconds: np.ndarray) -> float:
    """Return the mean of the slowest tenth of frames [s]."""
    return float(np.sort(seconds)[-max(1, len(seconds) // 10) :].mean())


def table1(scene: str, args: Namespace) -> lab.Row:
    """Return the row of a scene in Table 1, with both laws."""
    *counts, cpu, _ = PAPER[scene.split("_")[0]]
    row: dict[str, object] = {"scene": scene}
    worst = 0.0
    for law, changes in LAWS.items():
        with Result(run(f"table1_{law}", scene, args, *changes)) as result:
            ours = [len(result[name]) for name in ARRAYS.values()]
            seconds, products = result.frames.wall_time[1:], result.frames.products[1:]
            worst = max(worst, float(result.frames.step_error[1:].max()))
        if len(row) == 1:
            pairs = zip(ARRAYS, ours, counts, strict=True)
            row |= {name: f"{own:,} ({paper:,})" for name, own, paper in pairs}
        paper = f" ({cpu})" if law == "springs" else ""
        row[f"{law}: frames a second"] = f"{1 / seconds.mean():.3g}{paper}"
        row[f"{law}: slowest tenth"] = 1 / slowest_tenth(seconds)
        row[f"{law}: products"] = float(products.mean())
    return row | {"step error": worst}


# ---- tissue


def volumes(result: Result) -> np.ndarray:
    """Return the relative change (frames,) of the volume within the surface since rest."""
    triangles = result["surface/triangles"][:]
    shapes = (result["surface/points"][:], *result.frames.surface)
    values = np.array(
        [trimesh.Trimesh(points, triangles, process=False).volume for points in shapes]
    )
    return values[1:] / values[0] - 1


def tissue(scene: str, args: Namespace) -> lab.Row:
    """Return the row of a scene as tissue."""
    law = "material.law=neo-hookean", "material.poisson_ratio=0.47", "output.surface=true"
    with Result(run("tissue", scene, args, *law)) as result:
        change = volumes(result)
        means = mean(result, "iterations", "ksp_its", "products", "wall_time")
        return {
            "scene": scene,
            "cells": len(result["lattice/cells"]),
            "frames": len(change) - 1,
            "frames a second": 1 / means.pop("wall_time"),
            **means,
            "inside out": int(result.frames.inverted[:].max()),
            "volume": ", ".join(
                lab.percent(value, 2) for value in (change.min(), change.max(), change[-1])
            ),
        }


# ---- surfaces in self-contact

# number of frames in which crossings of the drawn surface are counted
COUNTED = 20


def cost(name: str, scene: str | Path, args: Namespace) -> tuple[Path, float]:
    """Run a scene; return its result file and the CPU time of a frame [ms]."""
    began = sum(getrusage(RUSAGE_CHILDREN)[:2])
    path = run(name, scene, args)
    time = lab.Run(path).cost["time"]
    cpu = sum(getrusage(RUSAGE_CHILDREN)[:2]) - began
    with Result(path) as result:
        frames = len(result.frames.time) - 1
    return path, 1e3 * cpu * time["stepping"] / (
        time["setup"] + time["stepping"] + time["output"]
    ) / frames


def without_contact(file: Path) -> Path:
    """Return a copy of a scene without [self_contact], with its meshes."""
    copy = OUT / "without" / file.name
    copy.parent.mkdir(parents=True, exist_ok=True)
    for mesh in file.parent.glob("*.ply"):
        shutil.copy(mesh, copy.parent)
    copy.write_text(re.sub(r"(?m)^\[self_contact\].*\n(?:(?!\[).*\n)*", "", file.read_text()))
    return copy


def touching(scene: str, args: Namespace) -> lab.Row:
    """Return the row of a scene with self-contact."""
    path, cpu = cost("touching", scene, args)
    file = lab.file_of(scene)
    kept = [change for change in args.set if not change.startswith("self_contact")]
    _, without = cost("without", without_contact(file), Namespace(**vars(args) | {"set": kept}))
    model = build_model(MPI.COMM_SELF, load_scene(file, args.set))
    assert (
        isinstance(model.collision, CollisionSurface) and model.collision.surface and model.surface
    )
    with Result(path) as result:
        whole = [*map(model.collision.points, result.frames.position, result.frames.time[:])]
        counted = np.unique(np.linspace(0, len(whole) - 1, COUNTED).round().astype(int))
        drawn = (result.embedding @ result.frames.position[index] for index in counted)
        least = np.nanmin(result.frames.self_distance[:])
        products = result.frames.products[1:]
        return {
            "scene": f"`{file.stem}`",
            "cells": len(model.lattice.cells),
            "triangles": len(model.collision.surface.triangles),
            "steps": len(whole) - 1,
            "contacts at most": int(result.frames.self_contacts[:].max()),
            "least distance [µm]": f"{1e6 * least:.2g} of {1e6 * model.collision.law.distance:.0f}",
            "crossed": sum(
                int(count_crossings(each, model.collision.surface.triangles)) for each in whole
            ),
            "drawn": sum(int(count_crossings(each, model.surface.triangles)) for each in drawn),
            **mean(result, "iterations", "products"),
            "median, most products": f"{np.median(products):,.0f}, {products.max():,}",
            "CPU ms a frame": cpu,
            "without contact": without,
        }


# ---- function of a row, and default scenes, of each table

TABLES = {
    "table1": (table1, SCENES),
    "tissue": (tissue, ("bunny_fall", "heart_pull", "brain_fall")),
    "touching": (touching, ("two_bunnies", "pile", "armadillo_fold", "lung_press_contact")),
}


def main() -> None:
    """Print the table that the command line names."""
    options = lab.parser(__doc__)
    options.add_argument("table", choices=TABLES)
    options.add_argument(
        "scenes", nargs="*", metavar="SCENE", help="names in scenes/ (the table's own)"
    )
    options.add_argument(
        "--frames", type=int, metavar="N", help="number of steps of each scene (all)"
    )
    options.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="changes of every scene"
    )
    options.add_argument("--shorter", type=int, default=1, metavar="N", help="divisor of the steps")
    args = options.parse_args()
    row, scenes = TABLES[args.table]
    lab.heading()
    lab.table(row(scene, args) for scene in args.scenes or scenes)


if __name__ == "__main__":
    main()
