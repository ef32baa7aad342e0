"""The keys of a scene in ``msmpetsc keys`` and for editors have units, defaults and ranges."""

import tomllib

import pytest
from conftest import ROOT
from jsonschema import Draft202012Validator

from msmpetsc.cli.commands.new import shipped_text, shipped_titles
from msmpetsc.errors import InputError
from msmpetsc.scene.key_table import SceneKey, json_schema, keys
from msmpetsc.scene.schema import SceneFile


def key(name: str) -> SceneKey:
    (found,) = (each for each in keys() if each.name == name)
    return found


def test_all_tables_and_keys_are_listed():
    assert {each.name.partition(".")[0] for each in keys()} == set(SceneFile.model_fields)
    assert len({each.name for each in keys()}) == len(keys())


def test_default_range_and_meaning_are_those_of_the_schema():
    density = key("material.density")
    assert density == ("material.density", "required", "> 0", "mass density [kg/m^3]")
    assert key("time.error").bounds == "> 0, < 1"
    assert key("cages.boundary").bounds == "fill | whole"
    assert key("cages.boundary").default == '"fill"'
    assert key("output.surface").default == "true"
    assert key("material.young_modulus").default == "one of young_modulus, stiffness"
    assert key("obstacle.N.stop").default == "none"
    assert key("obstacle.N.stop").about.endswith("to the end if absent")


def test_a_table_or_a_key_is_chosen_by_its_name_and_a_number_does_not_matter():
    assert [each.name for each in keys("gravity")] == ["gravity.acceleration"]
    assert keys("pin.0.region") == keys("pin.region") == keys("pin.N.region") != []
    assert all(each.name.startswith("time.") for each in keys("time"))
    with pytest.raises(InputError, match="did you mean 'material'"):
        keys("materiall")
    with pytest.raises(InputError, match=r"did you mean 'material\.density'"):
        keys("material.desnity")


@pytest.mark.parametrize("name", [path.stem for path in (ROOT / "scenes").glob("*.toml")])
def test_the_json_schema_takes_every_shipped_scene_and_no_mistake(name: str):
    schema, scene = json_schema(), tomllib.loads(shipped_text(name))
    valid = Draft202012Validator(schema).is_valid
    # TOML has no null
    assert "null" not in str(schema) and "None" not in str(schema)
    assert valid(scene)
    assert not valid(scene | {"obstacles": []})
    assert not valid(scene | {"material": {"density": 1000.0}})
    assert not valid(scene | {"time": scene["time"] | {"step": -1.0}})
    assert not valid(scene | {"time": scene["time"] | {"step": "2.5e-1 ms"}})
    assert valid(scene | {"gravity": {"acceleration": [0, 0, -9.81]}})
    assert not valid(scene | {"gravity": {"acceleration": [0, 0, "1 m"]}})


def test_all_scenes_of_the_clone_are_shipped():
    assert set(shipped_titles()) == {path.stem for path in (ROOT / "scenes").glob("*.toml")}
    assert all(shipped_titles().values())
