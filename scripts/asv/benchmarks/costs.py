"""Costs of small runs for `asv run`: machine-independent counts, peak memory and some times."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
import lab

CELLS = "cages={count=2000}"
FRAMES = {"armadillo_leg": 6, "heart_pull": 10, "lung_press": 20, "studies/beam_soft": 10}
# columns of frames that are averaged, without the first frame; times in seconds
MEANS = ("products", "proof_products", "iterations", "ksp_its", "wall_time")
TOTALS = ("memory [byte]", "setup [s]")


class Scenes:
    """The first frames of each scene on a small lattice."""

    params = (tuple(FRAMES), (*MEANS, *TOTALS))
    param_names = ("scene", "figure")
    timeout = 600

    def setup_cache(self) -> dict[str, dict[str, float]]:
        """Run each scene once and return its figures by name."""
        figures = {}
        for scene, frames in FRAMES.items():
            run = lab.run(
                scene, Path("run.h5"), ["--frames", frames], [CELLS, "output.surface=false"]
            )
            figures[scene] = {
                name: float(values[1:].mean()) for name, values in run.frames(*MEANS).items()
            }
            totals = run.cost["memory"], run.cost["time"]["setup"]
            figures[scene] |= dict(zip(TOTALS, totals, strict=True))
        return figures

    def track_figure(self, figures: dict[str, dict[str, float]], scene: str, figure: str) -> float:
        """Return a figure of a scene."""
        return figures[scene][figure]
