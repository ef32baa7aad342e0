"""Frames without a file equal the frames of msmpetsc.run, also many times on the same lattice.

Scenes come from files, tables and Scene objects.
"""

import gc
import tomllib
from pathlib import Path

import numpy as np
import pytest
from block_scene import DENSITY, GRAVITY, G, block_scene
from conftest import ENVIRONMENT, python, run

import msmpetsc as msm
from msmpetsc.app.ranks import ALONE
from msmpetsc.errors import InputError, StepFailed

FALL = {"gravity": GRAVITY, "time": {"step": 0.01, "duration": 0.03}}
HELD = {"pin": [{"region": {"box": [[-1, -1, -1], [0.01, 2, 2]]}}]}
INTEGRATORS = ("implicit-euler", "bdf2", "verlet")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Return the scene of a block that is held at one end and bends under its weight."""
    return block_scene(tmp_path, **FALL | HELD)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_frames_are_those_of_the_file(scene: Path, tmp_path: Path, integrator: str):
    changes = {"material.young_modulus": 2e5, "time.integrator": integrator}
    # a list: each frame must outlive the next step
    frames = list(msm.frames(scene, set=changes))
    with msm.open(msm.run(scene, tmp_path / "x.h5", set=changes, quiet=True)) as result:
        assert np.array_equal([frame.position for frame in frames], result.frames.position[:])
        assert [frame.time for frame in frames] == list(result.frames.time)
        assert [frame.elastic for frame in frames] == list(result.frames.elastic)
    # the block bends
    assert np.ptp(frames[-1].position - frames[0].position) > 1e-4


def test_tables_and_scenes_are_as_good_as_a_file(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    expected = [frame.position for frame in msm.frames(scene, 2)]
    tables = tomllib.loads(scene.read_text())
    # Python takes paths, arrays and NumPy's numbers
    tables["mesh"]["source"] = tmp_path / "scene.ply"
    tables["gravity"]["acceleration"] = np.array([0, 0, -G])
    tables["material"]["density"] = np.float64(DENSITY)
    # relative to / the mesh is missing; relative to the folder of the tables it exists
    monkeypatch.chdir("/")
    for source in (tables, msm.Scene.of(tables), msm.Scene.load(scene)):
        assert np.array_equal([frame.position for frame in msm.frames(source, 2)], expected)
        path = msm.run(source, tmp_path / "x.h5", frames=2, overwrite=True, quiet=True)
        with msm.open(path) as result:
            assert np.array_equal(result.frames.position[:], expected)
            # the scene of the file can be run again
            assert msm.Scene.of(result.scene).material.density == DENSITY
    with pytest.raises(InputError, match="say output"):
        msm.run(tables, quiet=True)


def test_a_run_of_tables_goes_on(scene: Path, tmp_path: Path):
    tables = tomllib.loads(scene.read_text())
    of_tables = msm.Scene.of(tables, tmp_path)
    whole = msm.run(of_tables, tmp_path / "whole.h5", quiet=True)
    part = msm.run(of_tables, tmp_path / "part.h5", frames=1, quiet=True)
    msm.run(resume=part, force=True, set={"time.duration": 0.03}, quiet=True)
    with msm.open(whole) as one, msm.open(part) as other:
        assert np.array_equal(one.frames.position[:], other.frames.position[:])


def test_changes_are_checked_as_a_file_is(scene: Path):
    simulation = msm.Simulation(scene)
    softer = simulation.scene.changed(
        {"material.young_modulus": 1e3, "pin.0.region.box": [[-1, -1, -1], [0.2, 2, 2]]}
    )
    assert softer.material.young_modulus == 1e3 and softer.pin[0].region.box[1][0] == 0.2
    assert simulation.scene.material.young_modulus != 1e3
    for wrong, words in {
        "material.yuong_modulus": "did you mean 'young_modulus'",
        "pin.7.region": "is no item of a list of 1",
    }.items():
        with pytest.raises(InputError, match=words):
            # the error comes at the call, before the first frame
            simulation.frames(set={wrong: 1.0})
    for frames, words in {0: "at least 1, not 0", 1.5: "a whole number, not 1.5"}.items():
        with pytest.raises(InputError, match=f"frames must be {words}"):
            simulation.frames(frames)
    with pytest.raises(InputError, match="unknown preset 'newtno', did you mean 'newton'"):
        next(simulation.frames(set={"solver.preset": "newtno"}))
    with pytest.raises(InputError, match="scene: material: required, but missing"):
        msm.Scene.of({"cages": {"count": 3}})


def test_the_lattice_is_kept_while_mesh_and_cages_are(scene: Path):
    simulation = msm.Simulation(scene)
    *_, first = simulation.frames(1, set={"output.surface": True})
    network, embedding = simulation.model.lattice.table, simulation.model.embedding
    for change in (
        {"material.young_modulus": 3e5, "material.density": 500.0},
        {"part": [{"region": {"box": [[0, 0, 0], [0.2, 1, 1]]}, "density": 2000.0}]},
        {
            "force": [{"region": {"box": [[0.4, 0, 0], [1, 1, 1]]}, "total": [0, 0, 9.0]}],
            "time.step": 0.005,
        },
    ):
        *_, kept = simulation.frames(set={"output.surface": True} | change)
        *_, fresh = msm.frames(scene, set={"output.surface": True} | change)
        assert simulation.model.lattice.table is network and simulation.model.embedding is embedding
        assert np.array_equal(kept.position, fresh.position)
        assert np.array_equal(kept.surface, fresh.surface)
        assert not np.array_equal(kept.position, first.position)
    list(simulation.frames(1, set={"cages.cell_size": 1 / 4}))
    assert simulation.model.lattice.table is not network
    assert simulation.model.lattice.cell_size == 1 / 4


def test_a_loop_may_end_early_and_leaves_nothing_behind(scene: Path):
    from petsc4py import PETSc

    before = PETSc.Options().getAll()
    simulation = msm.Simulation(scene, petsc_options={"ksp_rtol": 1e-3})
    for frame in simulation.frames():
        assert PETSc.Options().getAll()["ksp_rtol"] == "0.001"
        if frame.index == 1:
            break
    gc.collect()
    assert PETSc.Options().getAll() == before
    assert np.geterr()["invalid"] == "warn"
    assert len(list(simulation.frames())) == 4


@pytest.mark.parametrize(("end", "status"), [("", 0), ("raise SystemExit(5)", 5)])
def test_a_process_may_end_while_its_frames_have_not(scene: Path, end: str, status: int):
    """Frames, which hold PETSc objects, may outlive PETSc."""
    program = f"import sys, msmpetsc; f = msmpetsc.frames(sys.argv[1]); next(f); next(f)\n{end}"
    done = python("-c", program, scene, env=ENVIRONMENT | ALONE)
    assert done.returncode == status and "error" not in done.stderr.lower(), done.stderr


def test_two_simulations_may_go_side_by_side(scene: Path):
    one, other = msm.frames(scene), msm.frames(scene, set={"solver.preset": "anderson"})
    both = [(a.position, b.position) for a, b in zip(one, other, strict=True)]
    alone = [frame.position for frame in msm.frames(scene)]
    assert np.array_equal([a for a, _ in both], alone)
    assert all(np.allclose(a, b, atol=1e-7) for a, b in both)
    frames = msm.frames(scene)
    next(frames)
    with pytest.raises(InputError, match="another simulation is under way"):
        next(msm.frames(scene, petsc_options="-ksp_rtol 1e-2"))
    frames.close()
    with pytest.raises(InputError, match="-ksp_tpye"):
        next(msm.frames(scene, petsc_options="-ksp_tpye cg"))


def test_a_step_that_fails_raises_after_the_frames_before_it(tmp_path: Path):
    pull = [{"region": {"box": [[-1, -1, -1], [0.1, 2, 2]]}, "total": [1e4, 0, 0], "start": 0.015}]
    scene = block_scene(tmp_path, time=FALL["time"], force=pull)
    frames = msm.frames(scene, set={"solver.error": 1e-12}, petsc_options="-snes_max_it 1")
    assert [next(frames).index for _ in range(2)] == [0, 1]
    with pytest.raises(StepFailed, match="frame 2 "):
        next(frames)


def test_a_callback_sees_each_stored_frame_and_may_change_it(scene: Path, tmp_path: Path):
    def turned(frame: msm.Frame) -> None:
        seen.append((frame.index, frame.position.copy()))
        frame.position[:] -= frame.position.mean(axis=0)

    seen, few = [], {"output.every": 2}
    left = msm.run(scene, tmp_path / "left.h5", set=few, quiet=True)
    changed = msm.run(scene, tmp_path / "changed.h5", set=few, on_frame=turned, quiet=True)
    assert [index for index, _ in seen] == [0, 2, 3]
    with msm.open(left) as expected, msm.open(changed) as found:
        assert np.array_equal([position for _, position in seen], expected.frames.position[:])
        assert np.array_equal(found.frames.position[:], expected.frames.position[:])


def test_frames_are_those_of_every_third_step_and_the_last(tmp_path: Path):
    """Skipped steps compute no output, and the costs of all steps are summed."""
    time, solver = {"step": 0.02, "duration": 0.14}, {"preset": "anderson", "error": 1e-6}
    simulation = msm.Simulation(
        block_scene(tmp_path, **FALL | HELD | {"time": time, "solver": solver})
    )
    changes = {"output.surface": True}
    each, few = (list(simulation.frames(set=changes | {"output.every": every})) for every in (1, 3))
    assert [frame.index for frame in few] == [0, 3, 6, 7]
    for frame in few:
        same = each[frame.index]
        assert frame.time == same.time
        for name in ("position", "surface", "momentum", "kinetic", "elastic", "potential"):
            np.testing.assert_array_equal(getattr(frame, name), getattr(same, name))
    for frame, steps in zip(few[1:], (each[1:4], each[4:7], each[7:8]), strict=True):
        assert frame.iterations == sum(step.iterations for step in steps) > 0
        assert frame.ksp_its == sum(step.ksp_its for step in steps) > 0
        assert frame.products == sum(step.products for step in steps)
        assert frame.step_error == max(step.step_error for step in steps) > 0


def test_scenes_and_frames_print_one_line(scene: Path):
    simulation = msm.Simulation(scene)
    last = list(simulation.frames(2))[-1]
    for shown in (repr(simulation), repr(simulation.scene), str(simulation.scene), repr(last)):
        assert "\n" not in shown and len(shown) < 200, shown
    assert "cells of 0.125 m of scene.ply, implicit-euler" in repr(simulation.scene)
    assert repr(simulation) == f"Simulation({simulation.scene!r}, cpu, 1 rank)"
    assert repr(last).startswith("Frame(2: t = ") and str(last.position.shape) in repr(last)


ON_RANKS = """
import sys
import numpy as np
import msmpetsc as msm
from mpi4py import MPI
for _ in range(2):
    try:
        options = {"info": ":/dev/null", "ksp_rtol": 1e-3}
        msm.run(sys.argv[1], sys.argv[2] + "/x.h5", frames=1, petsc_options=options)
    except msm.errors.InputError as error:
        print("refused:", str(error).partition(" exists")[1])
simulation = msm.Simulation(sys.argv[1])
for modulus in (1e5, 2e5):
    *_, last = simulation.frames(set={"material.young_modulus": modulus})
    rows = MPI.COMM_WORLD.gather(last.position)
    if rows:
        assert all(len(part) for part in rows)
        np.save(sys.argv[2] + f"/{modulus:g}.npy", np.concatenate(rows))
"""


def test_on_ranks_each_has_its_rows(scene: Path, tmp_path: Path):
    done = run(3, "-c", ON_RANKS, scene, tmp_path, status=0)
    # only the second call fails, on all ranks
    assert done.stdout.count("refused:") == done.stdout.count(" exists") == 3
    assert done.stderr.count("frame 1/1") == 1
    for modulus in (1e5, 2e5):
        *_, last = msm.frames(scene, set={"material.young_modulus": modulus})
        assert np.allclose(np.load(tmp_path / f"{modulus:g}.npy"), last.position, atol=1e-9)
