#!/usr/bin/env python3
"""Holds states of equilibrium against the ends of dynamic runs, and prints a Markdown table. Needs the meshes.

    scripts/statics_study.py [--cells CELLS] [--scenes NAME...]     as many cells as the scenes have if not given

Each scene of the paper that ends at rest is run three times, every step or state to 1e-7: by statics; by implicit Euler
in the scene's own steps; and so long that it has come to rest. Distances are the largest of any node, of the last
positions, over the largest displacement of the last state of equilibrium. `last step` is how far a node still went in
the last of the scene's own steps, in the same measure: a run that has not come to rest cannot be nearer.
"""

import subprocess
import sys
from dataclasses import dataclass

from clone import ROOT, parser

import numpy as np

from msmpetsc.output.reader import Result

OUT, ERROR = ROOT / "out" / "statics_study", "1e-7"


@dataclass(frozen=True)
class Study:
    """A scene of the study.

    state : [s] from one state of equilibrium to the next, a part of the time that any load acts
    long  : changes of the scene that let it come to rest
    """

    state: float
    long: tuple[str, ...]


LONG = ("time.duration=4.8",)
STUDIES = {
    "armadillo_leg": Study(1.2, LONG),
    "armadillo_palm": Study(1.2, LONG),
    "armadillo_forehead": Study(1.6, LONG),
    "dragon_raise_push": Study(0.4, ("time.duration=10.0", "force.0.stop=5.0", "force.1.start=5.0")),
}


@dataclass(frozen=True)
class Outcome:
    """What a run came to.

    last, before : positions (n, 3) [m] of the last two frames
    rest         : (n, 3) [m]
    frames, new  : and those of them that took an iteration
    """

    last: np.ndarray
    before: np.ndarray
    rest: np.ndarray
    frames: int
    new: int
    iterations: int
    products: int
    seconds: float


def run(name: str, kind: str, changes: tuple[str, ...], cells: int | None) -> Outcome:
    """Run a scene, changed, and read what it came to."""
    path = OUT / f"{name}_{kind}.h5"
    changes += ("output.surface=false", *((f"cages.count={cells}",) if cells else ()))
    words = [word for change in changes for word in ("--set", change)]
    scene = ROOT / "scenes" / f"{name}.toml"
    command = [sys.executable, "-m", "msmpetsc", "run", scene, "-o", path, "--overwrite", "--error", ERROR, *words]
    subprocess.run([str(word) for word in command], check=True)
    with Result(path) as result:
        frames = result.frames
        iterations, products, times = (frames[key][1:] for key in ("iterations", "products", "wall_time"))
        return Outcome(
            last=frames.position[-1],
            before=frames.position[-2],
            rest=result.lattice.nodes[:],
            frames=len(times),
            new=int((iterations > 0).sum()),
            iterations=int(iterations.sum()),
            products=int(products.sum()),
            seconds=float(times.sum()),
        )


def farthest(a: np.ndarray, b: np.ndarray) -> float:
    """The largest distance [m] of any node (n, 3) in one place from itself in another."""
    return float(np.linalg.norm(a - b, axis=1).max())


def row(name: str, cells: int | None) -> str:
    """A row of the table."""
    study = STUDIES[name]
    static = run(name, "static", ('time.integrator="static"', f"time.step={study.state}"), cells)
    own, long = run(name, "own", (), cells), run(name, "long", study.long, cells)
    size = farthest(static.last, static.rest)
    off, still, at_rest = (
        farthest(*pair) / size for pair in ((own.last, static.last), (own.last, own.before), (long.last, static.last))
    )
    costs = [f"{o.iterations:,} | {o.products:,} | {o.seconds:.1f}" for o in (static, own)]
    states = f"{static.frames}, {static.new} new" if static.new < static.frames else f"{static.frames}"
    ratio = own.seconds / static.seconds
    ends = f"{off:.1g} | {still:.1g} | {at_rest:.1g} after {long.frames}"
    return f"| `{name}` | {states} | {costs[0]} | {own.frames} | {costs[1]} | {ratio:.0f} | {ends} |"


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--cells", type=int, help="of each body; as the scenes have it if absent")
    arguments.add_argument("--scenes", nargs="+", choices=STUDIES, default=list(STUDIES))
    given = arguments.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    costs = "iterations | products | s"
    ends = "times as long | apart | last step | apart at rest, steps"
    print(f"| scene | states | {costs} | steps | {costs} | {ends} |")
    print("|---" * 12 + "|")
    for name in given.scenes:
        print(row(name, given.cells), flush=True)


if __name__ == "__main__":
    main()
