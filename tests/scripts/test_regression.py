"""scripts/regression.py notices every stored number that changes; two quick scenes are as stored."""

import importlib.util
import json
from collections.abc import Callable
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from conftest import ROOT

from msmpetsc.errors import InputError

SCENE = "heart_pull"
pytestmark = pytest.mark.timeout(200)


@pytest.fixture(scope="module")
def script() -> ModuleType:
    loader = SourceFileLoader("regression", str(ROOT / "scripts" / "regression.py"))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("regression", loader))
    loader.exec_module(module)
    return module


@pytest.fixture
def stored() -> dict:
    return json.loads((ROOT / "tests" / "regression" / f"{SCENE}.json").read_text())


@pytest.fixture
def instead(script: ModuleType, stored: dict, tmp_path: Path, monkeypatch) -> Callable[[dict], None]:
    """instead(stored): runs nothing, finds what the repository has, and holds it against these numbers."""
    found = json.loads(json.dumps(stored))
    monkeypatch.setattr(script, "run", lambda *_: None)
    monkeypatch.setattr(script, "summary", lambda *_: found)
    monkeypatch.setattr(script, "STORED", tmp_path)
    return lambda numbers: (tmp_path / f"{SCENE}.json").write_text(json.dumps(numbers)) and None


@pytest.mark.parametrize("scene", ["heart_pull", "armadillo_leg"])
def test_quick_scenes_are_as_stored(script: ModuleType, scene: str, capsys):
    outcome = script.check(scene, 1, False)
    if outcome is None:
        pytest.skip(capsys.readouterr().out)
    assert outcome == []


def test_every_scene_is_stored_and_as_the_script_runs_it(script: ModuleType):
    names = {path.stem for path in (ROOT / "scenes").glob("*.toml")}
    assert names == set(script.SETTINGS) == {path.stem for path in script.STORED.glob("*.json")}
    for name, (steps, changes) in script.SETTINGS.items():
        run = json.loads((script.STORED / f"{name}.json").read_text())["run"]
        assert (run["steps"], run["changes"]) == (steps, list(changes))


def test_the_same_numbers_are_the_same(script: ModuleType, stored: dict, instead, capsys):
    instead(stored)
    assert script.main([SCENE]) == 0 and " same\n" in capsys.readouterr().out


def test_each_changed_number_is_noticed_and_named(script: ModuleType, stored: dict, instead, capsys):
    steps = stored["run"]["steps"]
    for name, number in stored["numbers"].items():
        values, unit = np.array(number["value"]), number["unit"]
        scale = script.allowed(steps, unit) * stored["scales"][unit]
        for part, status in ((0.9, 0), (1.1, 1)):  # of what is allowed
            changed = values.copy()
            changed.flat[-1] += part * scale
            instead(stored | {"numbers": stored["numbers"] | {name: {"unit": unit, "value": changed.tolist()}}})
            assert script.main([SCENE]) == status, name
            assert (f"{SCENE}: {name}: " in capsys.readouterr().out) == bool(status)


def test_the_tolerance_is_ten_times_the_sum_of_the_steps_errors(script: ModuleType):
    assert script.allowed(6, "m") == pytest.approx(10 * 1e-9 * (1 + 2 + 3 + 4 + 5 + 6))
    assert script.allowed(6, "J") == script.allowed(6, "kg m/s") == 2 * script.allowed(6, "m")


@pytest.mark.parametrize("name", ["cells", "nodes", "springs", "pinned", "frames"])
def test_counts_are_exact(script: ModuleType, stored: dict, instead, capsys, name: str):
    instead(stored | {"counts": stored["counts"] | {name: stored["counts"][name] + 1}})
    assert script.main([SCENE]) == 1
    assert f"{name}: {stored['counts'][name]}, stored {stored['counts'][name] + 1}" in capsys.readouterr().out


def test_what_is_nan_missing_or_not_stored_is_noticed(
    script: ModuleType, stored: dict, instead, tmp_path: Path, capsys
):
    instead(stored | {"numbers": stored["numbers"] | {"kinetic": {"unit": "J", "value": float("nan")}}})
    assert script.main([SCENE]) == 1
    instead(stored | {"numbers": {name: x for name, x in stored["numbers"].items() if name != "kinetic"}})
    assert script.main([SCENE]) == 1 and "stored not there" in capsys.readouterr().out
    instead(stored | {"run": stored["run"] | {"error": 1e-3}})
    assert script.main([SCENE]) == 1 and "is run otherwise" in capsys.readouterr().out
    (tmp_path / f"{SCENE}.json").unlink()
    assert script.main([SCENE]) == 1 and "--update" in capsys.readouterr().out


def test_update_stores_what_was_found(script: ModuleType, stored: dict, instead, tmp_path: Path):
    instead({})
    assert script.main([SCENE, "--update"]) == 0
    assert json.loads((tmp_path / f"{SCENE}.json").read_text()) == stored


def test_a_run_that_fails_fails_and_a_mesh_that_is_not_here_is_skipped(script: ModuleType, monkeypatch, capsys):
    def fail(error: Exception):
        def run(*_):
            raise error

        monkeypatch.setattr(script, "run", run)

    fail(RuntimeError("a step did not converge"))
    assert script.main([SCENE]) == 1 and f"{SCENE}: a step did not converge" in capsys.readouterr().out
    fail(InputError("mesh 'heart' is not here"))
    assert script.main([SCENE]) == 1  # nothing was compared
    assert "skipped: mesh 'heart' is not here\nno scene was run" in capsys.readouterr().out
