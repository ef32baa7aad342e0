"""Events and stages in PETSc's log, products with the Hessian, and their use by --measure."""

import json
import re
from pathlib import Path

import h5py
import pytest
from block_scene import GRAVITY, block_scene, plane_at, play
from conftest import run as on_ranks

FRAMES = 3
SWINGS = {
    "gravity": GRAVITY,
    "pin": [{"region": {"box": [[0, 0, 0], [0.01, 1, 1]], "relative": True}}],
    "time": {"step": 1 / 60, "duration": FRAMES / 60},
    "solver": {"preset": "newton", "error": 1e-6},
}
# name, count and seconds of an event
LINE = re.compile(r"^(\S.*?) +(\d+) \S+ (\S+) ")


def logged(text: str) -> dict[str, dict[str, tuple[int, float]]]:
    """Return the events of each stage of -log_view, with their counts and seconds."""
    tables = text.split("\nEvent  ", 1)[1].split("Object Type", 1)[0]
    stages = {}
    for part in tables.split("--- Event Stage ")[1:]:
        name, _, rows = part.partition("\n")
        found = (LINE.match(row) for row in rows.splitlines())
        stages[name.split(": ")[1]] = {m[1]: (int(m[2]), float(m[3])) for m in found if m}
    return stages


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, dict, dict]:
    """Run with a reference; return stages of the log, the measure file and frames' numbers."""
    folder = tmp_path_factory.mktemp("run")
    words = (
        "-o",
        folder / "o.h5",
        "--measure",
        folder / "m.json",
        "--true-error",
        2,
        "-pc_type",
        "mg",
        "-log_view",
    )
    # these solves estimate no error and end so early that an estimate is needed
    words = (*words, "-ksp_norm_type", "preconditioned", "-ksp_rtol", "0.3")
    done = on_ranks(
        1, "-m", "msmpetsc.cli.main", "run", block_scene(folder, **SWINGS), *words, status=0
    )
    with h5py.File(folder / "o.h5") as file:
        frames = {name: file["frames"][name][:] for name in ("products", "ksp_its", "wall_time")}
    return logged(done.stdout), json.loads((folder / "m.json").read_text()), frames


def test_events_are_in_their_stages(run: tuple):
    stages, _, _ = run
    assert {"msmpetsc grids", "msmpetsc hierarchy", "msmpetsc hessian"} <= set(stages["set-up"])
    names = "gradient", "energy", "hessian", "product", "fine", "cycle", "estimate", "local"
    assert {f"msmpetsc {name}" for name in names} <= set(stages["steps"])
    assert (
        stages["output"]["msmpetsc output"][0] == 1 + FRAMES and "SNESSolve" in stages["reference"]
    )
    assert not any(
        name.startswith("SNES") for stage in ("Main Stage", "output") for name in stages[stage]
    )


@pytest.mark.slow
def test_ghosts_and_contact_are_told_on_two_ranks(tmp_path: Path):
    floor = plane_at(0.01, response="penalty")
    words = block_scene(tmp_path, **SWINGS, obstacle=[floor]), "-o", tmp_path / "o.h5", "-log_view"
    done = on_ranks(2, "-m", "msmpetsc", "run", *words, status=0)
    steps = logged(done.stdout)["steps"]
    assert (
        steps["msmpetsc ghosts"][0] >= steps["msmpetsc product"][0] + steps["msmpetsc gradient"][0]
    )
    assert steps["msmpetsc contact"][0] > 0


def test_times_are_of_all_stages_of_the_run_but_not_of_its_reference(run: tuple):
    stages, cost, frames = run
    told = {
        "local": ["msmpetsc local"],
        "ksp": ["KSPSolve"],
        "hierarchy": ["msmpetsc grids", "msmpetsc hierarchy"],
    }
    for name, sources in told.items():
        rows = [
            stages[s].get(event)
            for s in ("Main Stage", "set-up", "steps", "output")
            for event in sources
        ]
        assert cost["time"][name] == pytest.approx(
            sum(row[1] for row in rows if row), rel=1e-3
        ) and any(rows)
    assert cost["time"]["local"] + cost["time"]["ksp"] < cost["time"]["stepping"]
    assert cost["time"]["stepping"] == pytest.approx(frames["wall_time"].sum())


def test_products_are_those_of_the_log(run: tuple):
    stages, cost, frames = run
    counts = [stages["steps"][f"msmpetsc {name}"][0] for name in ("product", "fine")]
    assert frames["products"].sum() == cost["products"] == sum(counts) and min(counts) > 0
    assert frames["products"][0] == 0 and (frames["products"][1:] > frames["ksp_its"][1:]).all()


def test_products_repeat_and_verlet_has_none(tmp_path: Path):
    first, again = (
        [frame.products for frame in play(block_scene(tmp_path, **SWINGS))[1]] for _ in range(2)
    )
    assert first == again and first[0] == 0 and min(first[1:]) > 0
    assert {
        frame.products
        for frame in play(block_scene(tmp_path, **SWINGS), 'time.integrator="verlet"')[1]
    } == {0}
