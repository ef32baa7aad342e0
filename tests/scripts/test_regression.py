"""scripts/regression.py: two quick scenes are as stored."""

import pytest
import regression
from conftest import ROOT

pytestmark = pytest.mark.timeout(200)


@pytest.mark.parametrize("scene", ["heart_tissue", "armadillo_leg"])
def test_quick_scenes_are_as_stored(scene: str, capsys):
    outcome = regression.check(scene, 1, False)
    if outcome is None:
        pytest.skip(capsys.readouterr().out)
    assert outcome == []


def test_every_scene_is_stored():
    assert {path.stem for path in (ROOT / "scenes").glob("*.toml")} == {
        p.stem for p in regression.STORED.glob("*.json")
    }
