"""Numbers with the word of a unit: the same double as in SI units, stored as that, and one line for a wrong word."""

import tomllib
from pathlib import Path

import pytest

from msmpetsc.errors import InputError
from msmpetsc.scene.keys import keys
from msmpetsc.scene.reading import load_scene
from msmpetsc.scene.schema import Scene
from msmpetsc.scene.units import WORDS

PLAIN = """\
[mesh]
source = "body.obj"     # a comment
size = 0.3
base = [0, 0.01, -0.0254]
[cages]
cell_size = 0.025
[material]
young_modulus = 1.5e6
density = 1100
[time]
step = 0.005
duration = 60
[[obstacle]]
shape = "plane"
point = [0, 0, -0.02]
normal = [0, 0, 1]
path = [{ time = 0.25, by = [0, 0, 0.003] }]
[[pin]]
region = { sphere = { center = [0, 0, 0.3], radius = 1000 } }
[[force]]
region = { box = [[0, 0, 0], [1, 1, 1]], relative = true }
total = { times = [0, 0.1], values = [[0, 0, 0], [0, 0, 2500]] }
"""
WORDED = """\
[mesh]
source = "body.obj"     # a comment
size = "300 mm"
base = [0, "1 cm", "-1in"]
[cages]
cell_size = "2.5 cm"
[material]
young_modulus = "1.5 MPa"
density = "1.1 g/cm^3"
[time]
step = "5ms"
duration = "1 min"
[[obstacle]]
shape = "plane"
point = [0, 0, "-.2e2 mm"]
normal = [0, 0, 1]
path = [{ time = "250 ms", by = [0, 0, "3 mm"] }]
[[pin]]
region = { sphere = { center = [0, 0, "30 cm"], radius = "1 km" } }
[[force]]
region = { box = [[0, 0, 0], [1, 1, 1]], relative = true }
total = { times = [0, "100 ms"], values = [[0, 0, 0], [0, 0, "2.5 kN"]] }
"""


def load(folder: Path, text: str, *overrides: str) -> Scene:
    (folder / "scene.toml").write_text(text)
    return load_scene(folder / "scene.toml", overrides)


def problem(folder: Path, text: str, *overrides: str) -> str:
    with pytest.raises(InputError) as caught:
        load(folder, text, *overrides)
    return str(caught.value).removeprefix(f"{folder}/")


def test_a_scene_with_words_is_the_scene_with_numbers(tmp_path: Path):
    plain, worded = load(tmp_path, PLAIN), load(tmp_path, WORDED)
    assert worded.model_dump(exclude={"text"}) == plain.model_dump(exclude={"text"})
    assert tomllib.loads(worded.text) == tomllib.loads(plain.text)  # what a result stores
    assert plain.text == PLAIN


def test_words_are_the_nearest_double(tmp_path: Path):
    """As if the number were written in SI units: a product of doubles is off in the last digit of some."""
    some = range(1, 3000, 7)
    assert any(thousandths * 1e-3 != thousandths / 1000 for thousandths in some)
    for thousandths in some:
        scene = Scene.of(tomllib.loads(PLAIN), changes={"mesh.size": f"{thousandths} mm"})
        assert scene.mesh.size == thousandths / 1000


@pytest.mark.parametrize("override", ["mesh.size=250 mm", "mesh.size=250mm", 'mesh.size="25 cm"', "mesh.size=0.25"])
def test_the_command_line_takes_words(tmp_path: Path, override: str):
    for text in (PLAIN, WORDED):
        scene = load(tmp_path, text, override)
        assert scene.mesh.size == 0.25 and tomllib.loads(scene.text)["mesh"]["size"] == 0.25


def test_python_takes_words():
    scene = Scene.of(tomllib.loads(WORDED), changes={"time.step": "2 ms"}).changed({"mesh.base": [0, 0, "7 mm"]})
    assert scene.time.step == 0.002 and scene.mesh.base == (0, 0, 0.007) and scene.cages.cell_size == 0.025


LENGTHS = "must be a number, or one with mm, cm, m, km or in"
WRONG = {
    'mesh.size="300 furlong"': f'mesh.size: {LENGTHS}, got "300 furlong"',
    'cages.cell_size="3 ms"': f'cages.cell_size: {LENGTHS}, got "3 ms"',
    'time.step="3 mm"': 'time.step: must be a number, or one with ms, s or min, got "3 mm"',
    'material.density="3 Pa"': 'material.density: must be a number, or one with kg/m^3 or g/cm^3, got "3 Pa"',
    'mesh.base=[0, "1 kg", 0]': f'mesh.base.1: {LENGTHS}, got "1 kg"',
    'force.0.total=[0, "1 m", 0]': 'force.0.total.1: must be a number, or one with mN, N or kN, got "1 m"',
    'mesh.size="0.3"': 'mesh.size: must be a number, got "0.3"',
    'mesh.size="3e-1"': 'mesh.size: must be a number, got "3e-1"',
    'mesh.size="mm"': 'mesh.size: must be a number, got "mm"',
    'mesh.size="-3 mm"': "mesh.size: must be > 0, got -0.003",
    'mesh.size="1e999 m"': "mesh.size: must be a finite number, got inf",
    'time.error="3 mm"': 'time.error: must be a number, got "3 mm"',
    'gravity.acceleration=[0, 0, "1 m"]': 'gravity.acceleration.2: must be a number, got "1 m"',
    'cages={ count = "3 m" }': 'cages.count: must be a whole number, got "3 m"',
    'force.0.region.box=[[0, 0, 0], [1, 1, "1 m"]]': "force.0.region: has no units where relative = true",
}


@pytest.mark.parametrize("override", WRONG)
def test_a_wrong_word_is_one_line_with_the_words_allowed(tmp_path: Path, override: str):
    line = problem(tmp_path, PLAIN, override)
    assert line.startswith(f"scene.toml: {WRONG[override]}") and "\n" not in line and "--set" in line


def test_a_wrong_word_in_a_file_has_its_line(tmp_path: Path):
    text = PLAIN.replace("size = 0.3\n", 'size = "3 s"\n', 1).replace("step = 0.005", 'step = "1 m"')
    first, second = problem(tmp_path, text).split("\n")
    assert first == f'scene.toml: mesh.size: {LENGTHS}, got "3 s" (line 3)'
    assert "time.step" in second and "(line 11)" in second


def test_each_unit_with_words_is_that_of_a_key_and_has_itself_among_them():
    units = {unit for key in keys() for unit in key.unit.split(" or ")}
    assert set(WORDS) <= units
    assert all(float(words[unit]) == 1 for unit, words in WORDS.items())
