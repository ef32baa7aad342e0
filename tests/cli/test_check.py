"""``msmpetsc check`` compares a scene with its stored numbers."""

import json
from pathlib import Path

import numpy as np
import pytest
from block_scene import GRAVITY, block_scene
from one_process import command_error, status_of

from msmpetsc.results.baseline import Numbers, Recipe, allowed, judged, read

STEPS = 3


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the scene of a falling block with its stored numbers."""
    folder = tmp_path_factory.mktemp("own")
    fall = {"time": {"step": 0.01, "duration": 1.0}, "gravity": GRAVITY}
    path = block_scene(
        folder, **fall, pin=[{"region": {"half_space": {"point": [0, 0, 0], "normal": [0, 0, -1]}}}]
    )
    words = "--frames", STEPS, "--set", "material.density=900.0"
    assert status_of("check", "--update", path, *words) == 0
    return path


@pytest.fixture
def numbers(scene: Path) -> Path:
    """Yield the file of stored numbers, and restore it after the test."""
    path = scene.with_suffix(".baseline.json")
    text = path.read_text()
    yield path
    path.write_text(text)


def test_the_numbers_say_how_they_were_made(numbers: Path):
    stored = json.loads(numbers.read_text())
    assert read(numbers).run == Recipe(cells=None, steps=STEPS, changes=["material.density=900.0"])
    # springs along edges and face diagonals of 4 x 4 x 2 cells
    springs = (60 + 60 + 50) + 2 * (48 + 40 + 40) + 4 * 32
    counts = {"cells": 32, "nodes": 75, "springs": springs, "pinned": 25, "frames": STEPS + 1}
    assert stored["counts"] == counts
    assert judged(read(numbers), read(numbers)) == []


@pytest.mark.parametrize("ranks", [1, 2])
def test_the_same_scene_has_the_same_numbers_on_any_ranks(scene: Path, ranks: int, capfd):
    assert status_of("check", scene, "--ranks", ranks) == 0
    assert capfd.readouterr().out.endswith(" same\n")


def test_what_differs_is_named(scene: Path, numbers: Path, capfd):
    stored = json.loads(numbers.read_text())
    stored["numbers"]["elastic"]["value"] += 2 * allowed(STEPS, "J") * stored["scales"]["J"]
    stored["numbers"]["highest corner"]["value"][2] += (
        0.5 * allowed(STEPS, "m") * stored["scales"]["m"]
    )
    stored["counts"]["pinned"] += 1
    numbers.write_text(json.dumps(stored))
    assert status_of("check", scene, "--json") == 1
    shown = json.loads(capfd.readouterr().out)
    wrong = shown["differences"][str(scene)]
    assert not shown["same"] and [line.partition(":")[0] for line in wrong] == ["elastic", "pinned"]


def test_a_scene_that_fails_is_named_and_the_others_are_checked(
    scene: Path, numbers: Path, tmp_path: Path, capfd
):
    # a scene whose mesh is elsewhere
    alone = tmp_path / "alone.toml"
    alone.write_text(scene.read_text())
    alone.with_suffix(".baseline.json").write_text(numbers.read_text())
    assert status_of("check", alone, scene) == 1
    out = capfd.readouterr().out
    assert "alone                FAILED\n" in out and " same\n" in out
    assert f"\n{alone}: the run failed: mesh" in out


def test_a_changed_scene_differs_until_its_numbers_are_stored_anew(
    scene: Path, numbers: Path, capfd
):
    text, before = scene.read_text(), json.loads(numbers.read_text())
    scene.write_text(text.replace("young_modulus = 100000.0", "young_modulus = 100010.0"))
    try:
        assert scene.read_text() != text and status_of("check", scene) == 1
        assert status_of("check", "--update", scene) == 0
    finally:
        scene.write_text(text)
    out, after = capfd.readouterr().out, json.loads(numbers.read_text())
    assert "DIFFERS" in out and f"{scene}: elastic: " in out
    assert after["run"] == before["run"] and after["numbers"] != before["numbers"]


def test_what_cannot_be_checked_is_refused_in_one_line(scene: Path, numbers: Path, tmp_path: Path):
    other = block_scene(tmp_path, time={"step": 0.01, "duration": 1.0, "error": 1e-2})
    few = ("--set", "time={step=1e-2, duration=1}")
    tiny = ("--set", "cages={cell_size=0.125, max_cells=1}")
    refused = {
        "nothing is stored of": ["check", str(other)],
        "no such scene file": ["check", str(tmp_path / "absent.toml")],
        "are for --update": ["check", str(scene), "--cells", "30"],
        "time.error": ["check", "--update", str(other)],
        "--frames must be at least 1": ["check", "--update", str(other), "--frames", "0"],
        "the run failed": ["check", "--update", str(other), *few, *tiny],
    }
    for words, command in refused.items():
        assert words in command_error(*command)
    for text in ("{}", "[1]", "nonsense", '{"run": 1, "counts": {}, "numbers": {}}'):
        numbers.write_text(text)
        assert f"{numbers} is damaged" in command_error("check", scene)


DAMAGE = {
    "scales.m": ("scales", "m", np.inf),
    # after so many steps the tolerance would allow any difference
    "steps": ("run", "steps", 10**9),
    "cells asked for": ("run", "cells asked for", "30, 40"),
    "run.changes": ("run", "changes", "mesh.source=x"),
    "counts.cells": ("counts", "cells", "32"),
    "numbers.kinetic": ("numbers", "kinetic", {"unit": "J", "value": np.nan}),
}


@pytest.mark.parametrize("place", DAMAGE)
def test_damaged_numbers_are_refused_before_anything_is_run(scene: Path, numbers: Path, place: str):
    table, key, value = DAMAGE[place]
    stored = json.loads(numbers.read_text())
    stored[table][key] = value
    numbers.write_text(json.dumps(stored))
    text = command_error("check", scene)
    assert "damaged" in text and place in text


def test_too_great_a_scale_hides_no_difference(numbers: Path):
    stored = json.loads(numbers.read_text())
    stored["scales"] = dict.fromkeys(stored["scales"], 1e300)
    stored["numbers"]["elastic"]["value"] += 1000.0
    (line,) = judged(read(numbers), Numbers.model_validate(stored))
    assert line.startswith("elastic: ")


def test_changes_that_come_with_the_numbers_name_nothing_elsewhere(
    scene: Path, numbers: Path, ball: Path
):
    stored = json.loads(numbers.read_text())
    stored["run"]["changes"] = [f"mesh.source={ball}"]
    numbers.write_text(json.dumps(stored))
    for command in (
        ["check", str(scene)],
        ["check", "--update", str(scene), "--set", f"mesh.source={ball}"],
    ):
        assert "is not in the scene's folder" in command_error(*command)
    assert json.loads(numbers.read_text()) == stored
