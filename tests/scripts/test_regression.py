"""scripts/regression.py notices what changed; two quick scenes are as stored."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import regression
from conftest import ROOT

from msmpetsc.study.baseline import Numbers

SCENE = "heart_pull"
STORED = json.loads((regression.STORED / f"{SCENE}.json").read_text())
pytestmark = pytest.mark.timeout(200)


@pytest.fixture
def instead(tmp_path: Path, monkeypatch) -> Callable[[dict], int]:
    """instead(stored): the status where these numbers are stored; finds what the repository has, without a run."""
    monkeypatch.setattr(regression.numbers, "found", lambda *_: Numbers.model_validate(STORED))
    monkeypatch.setattr(regression, "STORED", tmp_path)

    def status(numbers: dict, *words: str) -> int:
        (tmp_path / f"{SCENE}.json").write_text(json.dumps(numbers))
        return regression.main([SCENE, *words])

    return status


@pytest.mark.parametrize("scene", [SCENE, "armadillo_leg"])
def test_quick_scenes_are_as_stored(scene: str, capsys):
    outcome = regression.check(scene, 1, False)
    if outcome is None:
        pytest.skip(capsys.readouterr().out)
    assert outcome == []


def test_every_scene_is_stored():
    assert {path.stem for path in (ROOT / "scenes").glob("*.toml")} == {
        p.stem for p in regression.STORED.glob("*.json")
    }


def test_a_changed_number_or_count_is_noticed_and_named(instead, capsys):
    assert instead(STORED) == 0 and " same\n" in capsys.readouterr().out
    number = STORED["numbers"]["kinetic"]
    changed = STORED["numbers"] | {"kinetic": number | {"value": 1.001 * number["value"]}}
    assert instead(STORED | {"numbers": changed}) == 1 and f"{SCENE}: kinetic: " in capsys.readouterr().out
    assert instead(STORED | {"counts": STORED["counts"] | {"cells": 1}}) == 1
    assert f"{SCENE}: cells: " in capsys.readouterr().out


def test_update_stores_what_was_found(instead, tmp_path: Path):
    assert instead(STORED | {"counts": {}}, "--update") == 0
    assert json.loads((tmp_path / f"{SCENE}.json").read_text()) == STORED
