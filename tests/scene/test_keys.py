"""The keys of a scene as ``msmpetsc keys`` and editors have them: each with its unit, default and range."""

import re
import tomllib

import pytest
from conftest import ROOT

from msmpetsc.cli.commands.new import shipped_text, shipped_titles
from msmpetsc.errors import InputError
from msmpetsc.scene.keys import SceneKey, json_schema, keys
from msmpetsc.scene.schema import SceneFile


def key(name: str) -> SceneKey:
    (found,) = (each for each in keys() if each.name == name)
    return found


def test_all_tables_and_keys_are_listed():
    assert {each.name.partition(".")[0] for each in keys()} == set(SceneFile.model_fields)
    assert len({each.name for each in keys()}) == len(keys())


def test_unit_default_and_range_are_those_of_the_schema():
    density = key("material.density")
    assert (density.unit, density.default, density.bounds, density.about) == (
        "kg/m^3",
        "required",
        "> 0",
        "mass density",
    )
    assert key("time.error").bounds == "> 0, < 1"
    assert key("cages.boundary").bounds == "fill | whole" and key("cages.boundary").default == "fill"
    assert key("output.surface").default == "true"
    assert key("material.young_modulus").default == "one of young_modulus, stiffness"
    assert key("obstacle.N.stop").default == "to the end" and "absent" not in key("obstacle.N.stop").about
    assert key("mesh.prepare").unit == ""  # the units in its examples are not its own
    assert key("pin.N.region.box").unit == "m or -"


def test_a_table_or_a_key_is_chosen_by_its_name_and_a_number_does_not_matter():
    assert [each.name for each in keys("gravity")] == ["gravity.acceleration"]
    assert keys("pin.0.region") == keys("pin.region") == keys("pin.N.region") != []
    assert all(each.name.startswith("time.") for each in keys("time"))
    with pytest.raises(InputError, match="did you mean 'material'"):
        keys("materiall")
    with pytest.raises(InputError, match=r"did you mean 'material\.density'"):
        keys("material.desnity")


def accepts(schema: dict, node: dict, value: object) -> bool:
    """Whether a value is as the schema says, as far as an editor looks."""
    if "$ref" in node:
        node = schema["$defs"][node["$ref"].rpartition("/")[2]]
    if "anyOf" in node:
        return any(accepts(schema, choice, value) for choice in node["anyOf"])
    if "oneOf" in node and sum(set(choice["required"]) <= set(value) for choice in node["oneOf"]) != 1:
        return False
    if "enum" in node and value not in node["enum"]:
        return False
    kinds = {"object": dict, "array": list, "string": str, "boolean": bool, "number": (int, float), "integer": int}
    types = node.get("type", list(kinds))
    if not any(isinstance(value, kinds[kind]) for kind in ([types] if isinstance(types, str) else types)):
        return False
    if isinstance(value, str) and not re.search(node.get("pattern", ""), value):
        return False
    if isinstance(value, dict):
        inner = node.get("properties", {})
        known = set(value) <= set(inner) or node.get("additionalProperties", True)
        needed = set(node.get("required", ())) <= set(value)
        return (
            known
            and needed
            and all(accepts(schema, inner[name], each) for name, each in value.items() if name in inner)
        )
    if isinstance(value, list):
        inner = node.get("prefixItems") or [node["items"]] * len(value)
        return len(inner) == len(value) and all(map(accepts, [schema] * len(value), inner, value))
    return not value <= node.get("exclusiveMinimum", -1e99) if isinstance(value, float) else True


@pytest.mark.parametrize("name", [path.stem for path in (ROOT / "scenes").glob("*.toml")])
def test_the_json_schema_takes_every_shipped_scene_and_no_mistake(name: str):
    schema, scene = json_schema(), tomllib.loads(shipped_text(name))
    assert accepts(schema, schema, scene)
    assert not accepts(schema, schema, scene | {"obstacles": []})
    assert not accepts(schema, schema, scene | {"material": {"density": 1000.0}})
    assert not accepts(schema, schema, scene | {"time": scene["time"] | {"step": -1.0}})
    assert not accepts(schema, schema, scene | {"time": scene["time"] | {"step": "2.5e-1 ms"}})
    assert accepts(schema, schema, scene | {"gravity": {"acceleration": [0, 0, -9.81]}})
    assert not accepts(schema, schema, scene | {"gravity": {"acceleration": [0, 0, "1 m"]}})


def test_the_json_schema_has_no_null_which_toml_has_not():
    assert "null" not in str(json_schema()) and "None" not in str(json_schema())


def test_all_scenes_of_the_clone_are_shipped():
    assert set(shipped_titles()) == {path.stem for path in (ROOT / "scenes").glob("*.toml")}
    assert all(shipped_titles().values())
