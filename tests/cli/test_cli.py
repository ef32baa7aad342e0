"""The command line: output, refusals, and failures that neither hang nor leave files."""

import re
import subprocess
import tomllib
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from conftest import run
from one_process import Answers, answers_on, assert_one_line, refusal_in

from msmpetsc.cli.main import split_petsc_options
from msmpetsc.results.untrusted_file import finished

SCENE = """
[mesh]
source = "ball.ply"
[cages]
count = 150
[material]
young_modulus = 1e5
law = "linear"
density = 1000
[time]
step = 0.01
duration = 0.03
[gravity]
acceleration = [0, 0, -9.81]
[[pin]]
region = { box = [[0, 0, 0.8], [1, 1, 1]], relative = true }
[output]
surface = false
"""
COMMAND = ("-m", "msmpetsc.cli.main", "run")
ball = trimesh.creation.icosphere(subdivisions=2, radius=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder with scene.toml, its ball, and faulty meshes and scenes."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "scene.toml").write_text(SCENE)
    nan = ball.vertices.copy()
    nan[3] = np.nan
    meshes = {
        "ball": (ball.vertices, ball.faces),
        "nan": (nan, ball.faces),
        "foil": (ball.vertices * [1, 1, 1e-5], ball.faces),
        "open": (ball.vertices, ball.faces[20:]),
    }
    for name, (points, triangles) in meshes.items():
        trimesh.Trimesh(points, triangles, process=False).export(folder / f"{name}.ply")
    return folder


@pytest.fixture
def scene(folder: Path) -> Path:
    return folder / "scene.toml"


def on(ranks: int, *arguments: object, status: int | None = None) -> subprocess.CompletedProcess:
    return run(ranks, *COMMAND, *arguments, status=status)


# Output


def test_the_default_output_is_in_out_and_is_not_replaced_unasked(
    scene: Path, tmp_path: Path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert on(1, scene).returncode == 0
    result = tmp_path / "out/scene.h5"
    assert sorted(p.name for p in result.parent.iterdir()) == ["scene.h5", "scene.xdmf"]
    before = result.read_bytes()
    assert_one_line(on(1, scene, "--frames", "1"), 2, "out/scene.h5 exists", "--overwrite")
    assert result.read_bytes() == before
    assert on(1, scene, "--frames", "1", "--overwrite").returncode == 0
    with h5py.File(result) as file:
        assert finished(file) == 2


def test_each_option_changes_the_run(scene: Path, tmp_path: Path):
    out = tmp_path / "new" / "named.h5"
    more = "--preset newton --error 1e-6 --frames 2 --set cages.count=80 --set output.surface=true"
    on(1, "-ksp_max_it", "400", scene, "-o", out, *more.split(), status=0)
    with h5py.File(out) as file:
        as_run = tomllib.loads(file.attrs["scene"])
        assert as_run["solver"] == {"preset": "newton", "error": 1e-6}
        assert "-ksp_max_it 400" in file.attrs["petsc_options"]
        assert "--frames=2" in file.attrs["command"]
        assert finished(file) == 3
        assert 0 < file["frames/step_error"][:].max() <= 1e-6
        # 80 cells were asked for, and the file has 150
        assert len(file["lattice/cells"]) < 120
        assert file["frames/surface"].shape == (3, len(ball.vertices), 3)
    assert out.with_suffix(".xdmf").is_file()


def test_petsc_options_of_the_user_work_on_two_ranks(scene: Path, tmp_path: Path):
    words = "-ksp_type pipecg -ksp_view -log_view --frames 1"
    done = on(2, scene, "-o", tmp_path / "o.h5", *words.split(), status=0)
    assert "type: pipecg" in done.stdout and "type: cg\n" not in done.stdout
    assert done.stdout.count("PETSc Performance Summary") == 1
    stages = re.findall(r"^--- Event Stage .*?: (.*)", done.stdout, re.M)
    # PETSc 3.22 lists all stages
    assert {"Main Stage", "set-up", "steps", "output"} <= set(stages) and "Unknown" not in stages


@pytest.mark.parametrize(
    ("preset", "options", "seen"),
    [
        ("newton-multigrid", "-ksp_view", "type: mg"),
        ("fast-msm", "", ""),
        ("paper", "", ""),
        ("anderson", "-snes_type ngmres -snes_view", "SNES Object"),
        ("lbfgs", "-snes_view", "type is LBFGS"),
        ("anderson", "-snes_anderson_m 2 -snes_view", "Number of stored past updates: 2"),
        ("fast-msm", "-pc_type gamg -ksp_view", "type: gamg"),
    ],
)
def test_no_option_is_left_unused_and_the_users_wins(
    scene: Path, tmp_path: Path, preset: str, options: str, seen: str
):
    words = f"--preset {preset} --frames 1 {options} -options_left".split()
    done = on(1, scene, "-o", tmp_path / "o.h5", *words, status=0)
    assert "There are no unused options." in done.stdout
    assert seen in done.stdout


@pytest.mark.parametrize(
    ("given", "ours", "petsc"),
    [
        ("run s.toml -log_view", "run s.toml", "-log_view"),
        ("run -log_view s.toml", "run s.toml", "-log_view"),
        ("run -ksp_view -pc_type gamg s.toml", "run s.toml", "-ksp_view -pc_type gamg"),
        ("run s.toml -log_view --frames 2", "run s.toml --frames 2", "-log_view"),
        ("run s.toml -log_view -o out.h5", "run s.toml -o out.h5", "-log_view"),
        ("run s.toml -mg_levels_shift -0.5", "run s.toml", "-mg_levels_shift -0.5"),
        ("run s.toml --error 1e-3", "run s.toml --error 1e-3", ""),
    ],
)
def test_our_options_and_petscs_stand_in_any_order(given: str, ours: str, petsc: str):
    assert split_petsc_options(given.split()) == (ours.split(), petsc.split())


# Refusals


def test_an_unused_option_of_a_name_that_solving_might_read_is_told_at_the_end(
    scene: Path, tmp_path: Path
):
    # the preset newton has no nonlinear preconditioner
    done = on(1, scene, "-o", tmp_path / "o.h5", "--frames", "1", "-npc_ksp_view")
    assert_one_line(done, 2, "-npc_ksp_view")
    # the frames computed before the failure are complete
    assert sorted(p.name for p in tmp_path.iterdir()) == ["o.h5", "o.xdmf"]


def test_a_preconditioner_that_ranks_do_not_share_is_refused(scene: Path, tmp_path: Path):
    # PETSc's ICC works on a single rank
    done = on(2, scene, "-o", tmp_path / "o.h5", "-pc_type", "icc")
    assert_one_line(done, 2, "ICC")
    assert list(tmp_path.iterdir()) == []


def mesh(name: str, *more: str) -> list[str]:
    return sets(f"mesh.source={name}", *more)


def sets(*pairs: str) -> list[str]:
    return [word for pair in pairs for word in ("--set", pair)]


# by kind of mistake: arguments after the scene, and words of the error
BAD = {
    "mesh missing": (mesh("gone.ply"), ["gone.ply"]),
    "mesh NaN": (mesh("nan.ply"), ["nan.ply", "NaN"]),
    "mesh thin for its cells": (mesh("foil.ply", "cages={cell_size=1e-5}"), ["cages.max_cells"]),
    "mesh tiny": (sets("mesh.size=1e-300"), ["1e-300 m", "too small"]),
    "mesh far away": (sets("mesh.base=[1e300, 0, 0]"), ["1e+300 m", "too far away"]),
    "cells too small": (sets("cages={cell_size=1e-300}"), ["cages.cell_size", "1e-300"]),
    "preset unknown": (["--preset", "andersen"], ["'anderson'"]),
    "frames not a number": (["--frames", "many"], ["--frames", "many"]),
    "all pinned": (sets("pin.0.region.box=[[-1, -1, -1], [2, 2, 2]]"), ["held"]),
    "disk too small": (sets("time.duration=9e6"), ["GB"]),
    "no such KSP": (["-ksp_type", "nonsense"], ["KSP type nonsense"]),
    "option of PETSc misspelt": (["-log_veiw"], ["-log_veiw"]),
    "option of ours misspelt": (["--presett", "anderson"], ["'--preset'"]),
}
REFUSALS = [*((1, name) for name in BAD), *((2, name) for name in list(BAD)[::2])]


@pytest.fixture(scope="module")
def refusals(folder: Path) -> dict[tuple[int, str], Answers]:
    """Return the refusals by number of ranks and mistake; half of them run on two ranks."""
    found = {}
    for ranks in (1, 2):
        names = [name for number, name in REFUSALS if number == ranks]
        out = folder / f"refused{ranks}" / "o.h5"
        commands = [["run", folder / "scene.toml", "-o", out, *BAD[name][0]] for name in names]
        found |= {
            (ranks, name): answers
            for name, answers in zip(names, answers_on(ranks, commands), strict=True)
        }
    return found


@pytest.mark.parametrize(("ranks", "name"), REFUSALS)
def test_bad_input_is_one_line_from_one_rank(refusals: dict, ranks: int, name: str):
    line = refusal_in(refusals[ranks, name])
    assert all(word in line for word in BAD[name][1]), line


def test_nothing_is_left_of_refused_runs(folder: Path, refusals: dict):
    left = [path.name for ranks in (1, 2) for path in (folder / f"refused{ranks}").glob("*")]
    assert left == []


def test_what_is_odd_but_can_be_simulated_is(scene: Path, tmp_path: Path):
    words = ["--frames", "1", *mesh("open.ply", "pin=[]")]
    done = on(1, scene, "-o", tmp_path / "o.h5", *words, status=0)
    (warning,) = re.findall(r"^msmpetsc: warning: .*", done.stderr, re.M)
    assert "14 boundary edges" in warning


# Failures during a run


@pytest.mark.parametrize(("ranks", "preset"), [(1, "newton"), (2, "anderson")])
def test_a_step_that_does_not_converge_leaves_the_frames_before_it(
    scene: Path, tmp_path: Path, ranks: int, preset: str
):
    """A body rests until a force starts at 0.025 s, then its step fails.

    Frames 0 to 2 need no iteration, frame 3 several.
    """
    out = tmp_path / "o.h5"
    force = "force.0={region={sphere={center=[0,0,-1],radius=1}},total=[1e4,0,0],start=0.025}"
    at_rest = sets("gravity.acceleration=[0,0,0]", force, "time.duration=0.05")
    words = f"--preset {preset} --error 1e-12 -snes_max_it 1".split()
    done = on(ranks, scene, "-o", out, *at_rest, *words)
    assert_one_line(done, 3, "frame 3 ", "DIVERGED_MAX_IT", "residual", "try ")
    with h5py.File(out) as file:
        assert finished(file) == 3 and np.isfinite(file["frames/position"][:3]).all()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["o.h5", "o.xdmf"]
