"""Counts and memory of inspect agree with those of a run on R ranks; integers have limits."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from block_scene import DENSITY, YOUNG, block_scene
from conftest import ROOT, WORKERS, python, run
from mpi4py import MPI
from one_process import status_of

from msmpetsc.build import Geometry, build_model, fill_cages, read_bodies
from msmpetsc.cli.commands.inspect import MOST_BUILT
from msmpetsc.errors import InputError
from msmpetsc.lattice.partition_counts import Partition, count_partition
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.linear.ghosts import Ghosted
from msmpetsc.solve.linear.operators import assemble
from msmpetsc.solve.linear.unknowns import Unknowns

WORKER = WORKERS / "shares_worker.py"
SELF = MPI.COMM_SELF


@pytest.fixture
def scene(ball: Path, tmp_path: Path) -> Path:
    """Return the scene of a ball of 300 cells that strikes the ground, so steps need iterations."""
    path = tmp_path / "scene.toml"
    shutil.copy(ball, tmp_path / "ball.ply")
    path.write_text("""
        mesh = { source = "ball.ply" }
        cages = { count = 300 }
        material = { young_modulus = 1e5, density = 1000, law = "linear" }
        time = { step = 0.01, duration = 0.1 }
        start = { scale = [1, 1, 0.8] }
    """)
    return path


def counted(scene: Path, cells: int, ranks: int) -> Partition:
    """Return the counts of count_partition."""
    return count_partition(
        Geometry(SELF, load_scene(scene, [f"cages.count={cells}"])).topology, ranks
    )


def assert_counts_are_near_those_of_real_ranks(scene: Path, cells: int, rel: float) -> None:
    held = scene.with_name("held.json")
    run(3, WORKER, scene, held, f"cages.count={cells}", status=0)
    real = json.loads(held.read_text())
    found = {name: getattr(counted(scene, cells, 3), name) for name in real}
    assert all(sum(found[name]) == sum(real[name]) for name in ("cells", "nodes"))
    for name, rows in found.items():
        np.testing.assert_allclose(rows, real[name], rtol=0.15, err_msg=name)
    assert min(real["ghosts"]) > 0 and sum(real["cells"]) == pytest.approx(cells, rel=rel)


def test_the_counts_are_near_those_of_real_ranks(scene: Path, tmp_path: Path):
    """The counts agree also for several bodies: each has slabs along its own longest side."""
    assert_counts_are_near_those_of_real_ranks(scene, 3000, 0.01)
    turned = "{ rotate = { axis = [0, 1, 0], degrees = 90 } }"
    (tmp_path / "bar.obj").write_text((ROOT / "scenes/studies/beam.obj").read_text())
    bodies = [f"{{ mesh = {{ source = 'bar.obj', prepare = [{turn}] }} }}" for turn in ("", turned)]
    text = scene.read_text().replace(
        'mesh = { source = "ball.ply" }', f"body = [{', '.join(bodies)}]"
    )
    scene.write_text(text)
    assert_counts_are_near_those_of_real_ranks(scene, 2000, 0.2)


def test_what_is_scaled_is_near_what_is_counted(scene: Path):
    """With 8 times the cells on 8 ranks sums agree to the surface term, ghosts to a quarter."""
    coarse, fine = (counted(scene, cells, 8) for cells in (4000, 32000))
    scaled = coarse.scaled(fine.cells.sum())
    for name, tolerance in {
        "nodes": 0.01,
        "nonzeros": 0.01,
        "springs": 0.03,
        "ghosts": 0.25,
    }.items():
        assert getattr(scaled, name).mean() == pytest.approx(
            getattr(fine, name).mean(), rel=tolerance
        ), name
    assert scaled.ghosts.mean() > 1.5 * coarse.ghosts.mean()
    assert scaled.neighbours is coarse.neighbours


def test_a_lattice_too_large_for_petsc_is_refused(scene: Path, monkeypatch):
    lattice = build_model(SELF, load_scene(scene)).lattice
    nodes, nonzeros = lattice.owned, lattice.owned + 2 * len(lattice.springs)
    monkeypatch.setattr("msmpetsc.solve.petsc.library.LARGEST", 3 * nodes - 1)
    for holder in (Unknowns, Ghosted.of):
        with pytest.raises(
            InputError, match=f"{nodes} nodes are more than the {3 * nodes - 1} unknowns"
        ):
            holder(SELF, lattice)
    monkeypatch.setattr("msmpetsc.solve.petsc.library.LARGEST", nonzeros - 1)
    unknowns = Unknowns(SELF, lattice)
    with pytest.raises(InputError, match=f"{nonzeros} nonzeros"):
        assemble(SELF, unknowns, 0.01)
    monkeypatch.setattr("msmpetsc.solve.petsc.library.LARGEST", nonzeros)
    assemble(SELF, unknowns, 0.01).destroy()


def test_a_scene_too_large_to_build_is_scaled_and_says_so(scene: Path, capsys, monkeypatch):
    monkeypatch.setattr("msmpetsc.cli.commands.inspect.MOST_BUILT", 1000)
    many = "cages={count = 800000, max_cells = 100000}"
    with pytest.raises(InputError, match=r"more than cages\.max_cells"):
        fill_cages(read_bodies(SELF, load_scene(scene)), load_scene(scene, [many]).cages)
    assert status_of("inspect", scene, "--ranks", "8", "--set", many) == 0
    told = capsys.readouterr()
    assert "scaled from a lattice of" in told.out and "run refuses 800000 cells" in told.err
    assert status_of("inspect", scene, "--set", "cages={cell_size = 0.02}") == 0
    (cells,) = [
        line.split()[1] for line in capsys.readouterr().out.splitlines() if line.startswith("cells")
    ]
    # volume of 320 triangles inside the sphere
    volume = 4 / 3 * np.pi * 0.98
    assert int(cells) == pytest.approx(volume / 0.02**3, rel=0.1)


@pytest.mark.parametrize(("preset", "factors"), [("fast-msm", True), ("lbfgs", False)])
def test_a_factor_that_the_memory_lacks_is_told(scene: Path, capsys, preset: str, factors: bool):
    assert status_of("inspect", scene, "--set", f"solver.preset={preset}") == 0
    words = f"the memory lacks the Cholesky factor of {preset}"
    assert (words in capsys.readouterr().err) == factors


@pytest.mark.parametrize("most", [MOST_BUILT, 100])
@pytest.mark.parametrize(
    ("law", "cages", "bending"),
    [
        ("linear", {"count": 300}, 0.08),
        ("linear", {"cell_size": 2e-3}, 0.17),
        ("linear", {"cell_size": 1e-3}, 0.44),
        ("neo-hookean", {"count": 300}, None),
    ],
)
def test_a_body_thinner_than_a_cell_is_told_with_the_cells_that_would_do(
    tmp_path: Path,
    capsys,
    monkeypatch,
    law: str,
    cages: dict[str, float],
    bending: float | None,
    most: int,
):
    """Inspect warns of a strip of 100 x 20 x 1 mm only if cells or springs make it too stiff.

    The strip lies along the grid. Cells of 3.3 to 1 mm are counted or scaled.
    """
    monkeypatch.setattr("msmpetsc.cli.commands.inspect.MOST_BUILT", most)
    strip = block_scene(
        tmp_path, np.array([0.1, 0.02, 0.001]), cages=cages,
        material={"young_modulus": YOUNG, "density": DENSITY, "law": law},
        time={"step": 0.01, "duration": 0.1},
    )  # fmt: skip
    assert status_of("inspect", strip) == 0
    told = capsys.readouterr()
    words = re.search(r"bends by about (.*) of theory: cages.count = (\d+) or (.*) makes", told.err)
    assert (words is not None) == (bending is not None)
    if words:
        assert float(words[1]) == pytest.approx(bending, abs=0.05)
        assert words[3] == "cages.cell_size = 0.00028" and words[2] == "130000"
    across = re.search("the body is (.*) cells thick, (.*) at its thin tenth", told.out)
    assert across and float(across[1]) == pytest.approx(float(across[2]), rel=0.05)


def test_memory_is_that_of_the_process_not_of_its_parent():
    code = "from msmpetsc.backend.machine import peak_memory; print(peak_memory())"
    # 600 MB
    large = np.ones(75_000_000)
    assert 1e7 < int(python("-c", code).stdout) < large.nbytes


@pytest.mark.slow
@pytest.mark.parametrize("law", ["neo-hookean", "linear"])
def test_the_memory_of_a_run_is_within_a_tenth(tmp_path: Path, capsys, law: str):
    """The memory of a block of 67,000 nodes is measured in a process of its own."""
    code = (
        "import sys; from msmpetsc import Simulation; from msmpetsc.backend.machine import "
        "peak_memory; list(Simulation(sys.argv[1]).frames()); print(peak_memory())"
    )
    # the first process compiles kernels, which takes more memory
    for cells in (100, 60_000):
        path = block_scene(
            tmp_path, cages={"count": cells}, output={"surface": False},
            material={"young_modulus": YOUNG, "density": DENSITY, "law": law},
            time={"step": 0.01, "duration": 0.02},
        )  # fmt: skip
        measured = int(python("-c", code, str(path)).stdout)
    assert status_of("inspect", path, "--json") == 0
    assert json.loads(capsys.readouterr().out)["memory"]["all"] == pytest.approx(measured, rel=0.1)
