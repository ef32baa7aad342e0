"""``msmpetsc baseline``: store the numbers of a scene, to be held against those of later runs by ``check``."""

import argparse
import tempfile
from pathlib import Path

from msmpetsc.cli.arguments import MEASURE_NAMES, RUNS_ITSELF, refuse_below_one, refuse_other_format, refuse_ranks
from msmpetsc.errors import InputError
from msmpetsc.scene.reading import load_scene
from msmpetsc.study.baselines import baseline
from msmpetsc.study.baselines.baseline import Numbers, Recipe


def run(args: argparse.Namespace) -> int:
    """Run the scene and store its numbers; return the exit status."""
    refuse_ranks("baseline", RUNS_ITSELF)
    refuse_below_one(frames=args.frames, cells=args.cells, ranks=args.ranks)
    refuse_other_format("-o", args.output, MEASURE_NAMES)
    path = args.output or stored_beside(args.scene)
    if path.exists() and not args.overwrite:
        raise InputError(f"{path} exists already: --overwrite stores other numbers in its place")
    scene = load_scene(args.scene, args.set, by_user=False)  # or check could not read what this stores
    if scene.time.error is not None:
        raise InputError(
            f"{args.scene}: time.error chooses steps by an estimate: how far numbers may be apart then is not known; "
            "--set time={step=..., duration=...} takes steps of one length"
        )
    steps = min(args.frames, scene.time.steps)
    numbers = found(args.scene, Recipe(args.cells, steps, tuple(args.set)), args.ranks)
    baseline.write(path, numbers)
    count = sum(map(len, (numbers["counts"], numbers["numbers"])))
    print(f"{path}: {count} numbers after {steps} steps, positions to {baseline.allowed(steps, 'm'):.1g}")
    return 0


def stored_beside(scene: Path) -> Path:
    """Return where the numbers of a scene are stored."""
    return scene.with_suffix(".baseline.json")


def found(scene: Path, recipe: Recipe, ranks: int) -> Numbers:
    """Run a scene by a recipe; return its numbers. Raises InputError where the run fails."""
    load_scene(scene, recipe.changes, by_user=False)  # they come with the scene, and name what lies beside it
    with tempfile.TemporaryDirectory(prefix="msmpetsc-numbers-") as folder:
        path = Path(folder) / "run.h5"
        try:
            baseline.simulate(scene, recipe, path, ranks)
        except RuntimeError as error:
            raise InputError(f"{scene}: the run failed: {error}") from None
        except OSError as error:  # of a full disk, of an mpiexec that is not there
            raise InputError(f"{error.filename}: {error.strerror}") from None
        return baseline.summary(path, recipe)
