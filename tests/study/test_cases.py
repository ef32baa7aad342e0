"""The cases of a study file: refusals, combinations of a sweep, definition of a case."""

# ruff: noqa: F811 (fixtures are imported)
import json
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import ROOT
from one_process import command_error, input_error
from study_files import ONE_SCENE, all_cases, carry_out, own_log, stand_in, study_file  # noqa: F401 (fixtures)

from msmpetsc.study.cases import shown_command, study_cases
from msmpetsc.study.study_file import load_study


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("[[sweep]]\nprests = []", ["sweep.0.prests", "'presets'"]),
        ('[[sweep]]\npresets = ["newtom"]', ["sweep.0.presets.0", "newton"]),
        ("[[sweep]]\nerrors = [2.0]", ["sweep.0.errors.0", "must be less than 1"]),
        ("[[sweep]]\nranks = [9999999]", ["sweep.0.ranks.0", "less than or equal to 1000000"]),
        ('[[sweep]]\noptions = ["-pc_type \'icc"]', ["sweep.0.options.0", "no closing quotation"]),
        ('reference.integrator = "bdf2"\n[[sweep]]', ["scene.0.reference", "needs step"]),
        ("steps = 3\nduration = 0.5\n[[sweep]]", ["scene.0.duration", "beside steps"]),
        (ONE_SCENE + "[[sweep]]", ["scene", "two scenes", "'a'"]),
        ("", ["sweep", "required"]),
    ],
)
def test_a_mistake_in_a_study_file_is_one_line(tmp_path: Path, wrong: str, words: list[str]):
    text = input_error(lambda: load_study(study_file(tmp_path, ONE_SCENE + wrong)))
    assert all(word in text for word in words), text


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ('file = "gone.toml"', ["gone.toml", "no such scene"]),
        ('file = "scene.toml"\nset = ["cages.cuont=3"]', ["cages.cuont", "'count'"]),
        (
            'file = "scene.toml"\nreference = { integrator = "implicit-euler", step = 0.003 }',
            ["no multiple", "0.003"],
        ),
    ],
)
def test_a_wrong_scene_is_told_before_anything_is_run(
    tmp_path: Path, stand_in, wrong: str, words: list[str]
):
    text = input_error(lambda: carry_out(tmp_path, f'[[scene]]\nname = "a"\n{wrong}\n[[sweep]]'))
    assert all(word in text for word in words), text
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_is_one_line(tmp_path: Path, own_log):
    path = study_file(tmp_path, ONE_SCENE + "[[sweep]]")
    (tmp_path / "file").touch()
    (tmp_path / "taken" / "table.csv").mkdir(parents=True)
    for folder in ("file/out", "taken", "file"):
        assert str(tmp_path / folder) in command_error("study", path, "-o", tmp_path / folder)


def test_a_sweep_is_a_product(tmp_path: Path):
    lists = {
        "presets": ["newton", "anderson"], "options": ["", "-pc_type icc"], "cells": [10, 20],
        "time_steps": [0.01, 0.02], "errors": [0.1, 0.01], "max_iterations": [5], "ranks": [1, 2],
    }  # fmt: skip
    sweep = "\n".join(f"{name} = {json.dumps(values)}" for name, values in lists.items())
    found = all_cases(tmp_path, f"{ONE_SCENE}[[sweep]]\n{sweep}")
    # a case has an error or a budget, not both
    assert len(found) == 2 * 2 * 2 * 2 * (2 + 1) * 2
    assert len({one.id for one in found}) == len(found)
    # presets times options times ranks
    assert len({one.label for one in found}) == 2 * 2 * 2
    last = shown_command(found[-1])
    assert last.startswith("mpiexec -n 2 msmpetsc run ") and last.endswith("-pc_type icc")
    assert "cages.count=20" in last and 'preset = "anderson", max_iterations = 5' in last
    assert 'step = 0.02, duration = 0.1, integrator = "implicit-euler"' in last


@pytest.mark.parametrize("integrator", ["static", "bdf2"])
def test_a_sweep_without_integrators_takes_that_of_the_scene(tmp_path: Path, integrator: str):
    scene = f'{ONE_SCENE}set = ["time.integrator={integrator}"]\n'
    (found,) = all_cases(tmp_path, scene + "[[sweep]]")
    assert found.integrator == integrator
    assert f'integrator = "{integrator}"' in shown_command(found)


def test_what_has_no_meaning_for_verlet_is_not_multiplied(tmp_path: Path):
    sweep = '[[sweep]]\nintegrators = ["verlet", "implicit-euler"]\nsubsteps = [1e-4, 1e-5]\n'
    sweep += 'presets = ["newton", "anderson"]'
    found = all_cases(tmp_path, ONE_SCENE + sweep)
    assert [(one.integrator, one.preset, one.substep) for one in found] == [
        ("verlet", "", 1e-4), ("verlet", "", 1e-5),
        ("implicit-euler", "newton", None), ("implicit-euler", "anderson", None),
    ]  # fmt: skip


def test_nothing_is_measured_beyond_the_end_of_a_case(tmp_path: Path):
    """The scene's steps are of 0.01 s: 3 of them, or 1."""
    scene = ONE_SCENE + "duration = 0.03\ntrue_error = 2\n"
    found = all_cases(tmp_path, scene + "[[sweep]]\ntime_steps = [0.01, 0.03]")
    assert [case.true_error for case in found] == [2, 1]


def test_full_cases_are_for_full_studies_and_none_comes_twice(tmp_path: Path):
    text = ONE_SCENE + "[[sweep]]\nerrors = [0.1]\n[[sweep]]\nerrors = [0.1, 0.01]\nfull = true"
    assert [one.error for one in all_cases(tmp_path, text)] == [0.1]
    assert [one.error for one in all_cases(tmp_path, text, full=True)] == [0.1, 0.01]


def test_a_case_is_its_scene_its_mesh_and_its_options(tmp_path: Path):
    (tmp_path / "box.ply").write_text("a mesh")
    text = ONE_SCENE + "[[sweep]]"
    (before,) = all_cases(tmp_path, text)
    assert replace(before, label="x", timeout=1.0).id == before.id
    assert replace(before, options="-pc_type icc").id != before.id
    (tmp_path / "box.ply").write_text("another mesh")
    (after,) = all_cases(tmp_path, text)
    assert after.id != before.id


def test_a_reference_of_its_own_cells_is_one_for_all_lattices(tmp_path: Path):
    """A reference with its own cells has neither a case's cells nor the sweep's changes.

    Its runs store surfaces, which are compared.
    """
    reference = 'reference = { cells = 5000, integrator = "bdf2", step = 0.005 }\n'
    sweep = '[[sweep]]\ncells = [10, 80]\n[[sweep]]\ncells = [10]\nset = ["cages.boundary=whole"]'
    found = all_cases(tmp_path, ONE_SCENE + reference + sweep)
    (one,) = {case.reference.id: case.reference for case in found}.values()
    assert one.cells == 5000 and "cages.count=5000" in one.set
    assert "cages.boundary=whole" not in one.set
    assert len(found) == 3 and all(case.stores_surface for case in (one, *found))
    own = reference.replace("cells = 5000, ", "")
    (few, _) = all_cases(tmp_path, f"{ONE_SCENE}{own}[[sweep]]\ncells = [10, 80]")
    assert few.reference.set[0] == "cages.count=10"
    assert not few.stores_surface and not few.reference.stores_surface


def test_a_law_is_that_of_the_reference_too(tmp_path: Path):
    """Each law has its own reference, unless the scene names the law of a common reference."""
    reference = 'reference = { cells = 5000, integrator = "bdf2", step = 0.005 }\n'
    sweep = '[[sweep]]\nlaws = ["linear", "neo-hookean"]'
    found = all_cases(tmp_path, ONE_SCENE + reference + sweep)
    assert [case.label for case in found] == ["linear", "neo-hookean"]
    for case in found:
        assert all(f"material.law={case.label}" in each.set for each in (case, case.reference))
    methods = '\npresets = ["newton", "anderson"]\noptions = ["", "-pc_type icc"]'
    assert len({case.label for case in all_cases(tmp_path, ONE_SCENE + sweep + methods)}) == 2 * 4
    common = reference.replace("cells", 'law = "linear", cells')
    for case in all_cases(tmp_path, ONE_SCENE + common + sweep):
        laws = [word for word in case.reference.set if word.startswith("material.law")]
        assert laws[-1] == "material.law=linear"


def test_the_studies_shipped_are_sound():
    for name in ("pareto", "figure6", "growth"):
        path = ROOT / "scenes" / "studies" / f"{name}.toml"
        few, many = (study_cases(load_study(path), path.parent, full) for full in (False, True))
        assert 10 < len(few) < 130 and len(few) < len(many)
    sizes, atlas = (
        study_cases(load_study(path.with_name(f"{name}.toml")), path.parent, False)
        for name in ("size", "stability")
    )
    maps = {one.point.map for one in atlas if one.point}
    assert 500 < len(atlas) < 1200 and maps >= {"beam", "press", "cases"}
    assert len({case.scene for case in sizes}) == 4 and all(case.stores_surface for case in sizes)
