"""Scene files: their meaning, and a line for every mistake."""

import json
import math
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msmpetsc.errors import InputError
from msmpetsc.scene.reading import Scene, load_scene
from msmpetsc.scene.schema import SceneFile

EXAMPLE = """\
title = "Bunny falls and leaps"

[mesh]
source = "bunny"                       # a registry name, or a path beside this file
prepare = ["repair", "orient", { simplify = 5000 }, { rotate = { axis = [0, 0, 2], degrees = 90 } }]
size = 0.3                             # longest side [m]

[cages]
count = 9946                           # or cell_size [m]
embedding = "affine"

[material]
young_modulus = 5e4                    # [Pa]
density = 1000                         # [kg/m^3]

[time]
step = 0.0166667                       # [s]
duration = 2.0

[gravity]
acceleration = [0, 0, -9.81]           # [m/s^2]

[[obstacle]]
shape = "plane"
point = [0, 0, 0]
normal = [0, 3, 4]
response = "reflect"

[[pin]]
region = { box = [[0, 0, 0.9], [1, 1, 1]], relative = true }

[[pin]]
region = { sphere = { center = [0, 0, 1], radius = 0.5 } }

[[force]]
region = { half_space = { point = [0, 0, 1], normal = [0, 0, 1] } }
total = [1, 0, 0]
stop = 0.5

[solver]
preset = "anderson"
error = 1e-3

[output]
surface = false
"""

SMALLEST = """\
mesh.source = "bunny"
cages.count = 100
material.young_modulus = 1e4
material.density = 1000
time.step = 0.01
time.duration = 1
"""


def load(folder: Path, text: str = EXAMPLE, *overrides: str) -> Scene:
    path = folder / "scene.toml"
    path.write_bytes(text.encode())
    return load_scene(path, overrides)


def problems(folder: Path, text: str, *overrides: str) -> list[str]:
    """Return the lines of the error, without the path of the temporary folder."""
    with pytest.raises(InputError) as caught:
        load(folder, text, *overrides)
    return str(caught.value).replace(f"{folder}/", "").split("\n")


def changed(old: str, new: str) -> str:
    assert EXAMPLE.count(old) == 1
    return EXAMPLE.replace(old, new)


# --- meaning of a scene


def test_line_ends_and_byte_order_mark_of_windows_editors(tmp_path):
    text = "\ufeff" + EXAMPLE.replace("\n", "\r\n")
    assert load(tmp_path, text).cages.count == 9946
    assert problems(tmp_path, text.replace("9946", "0")) == [
        "scene.toml: cages.count: must be greater than 0, got 0"
    ]


@given(st.tuples(*3 * [st.floats(allow_nan=False, allow_infinity=False)]).filter(any))
@settings(max_examples=50, deadline=None)
def test_directions_are_unit_vectors_at_any_magnitude(given):
    overrides = (
        f"obstacle=[{{shape='plane', point=[0,0,0], normal={list(given)}}}]",
        f"picture.eye={list(given)}",
        f"start.twist={{axis={list(given)}, degrees=9}}",
        f"start.swirl={{axis={list(given)}, distances=[0, 1], rates=[0, 1]}}",
        f"mesh.prepare=[{{rotate={{axis={list(given)}, degrees=9}}}}]",
    )
    with tempfile.TemporaryDirectory() as folder:
        scene = load(Path(folder), SMALLEST, *overrides)
    rotation = scene.mesh.prepare[0]["rotate"]["axis"]
    axes = scene.start.twist.axis, scene.start.swirl.axis, rotation
    for direction in (scene.obstacle[0].normal, scene.picture.eye, *axes):
        assert math.hypot(*direction) == pytest.approx(1, abs=1e-15)
        longest = max(range(3), key=lambda i: abs(given[i]))
        assert direction[longest] * given[longest] > 0


def test_every_key_is_described_with_its_unit():
    schema = SceneFile.model_json_schema()
    tables = [schema, *schema["$defs"].values()]
    assert len(tables) > 10
    for table in tables:
        for name, field in table["properties"].items():
            assert field["description"], name
            numeric = '"number"' in json.dumps(field) or '"integer"' in json.dumps(field)
            assert not numeric or "[" in field["description"], name


# --- mistakes, a line each

SPHERE = "{ sphere = { center = [0, 0, 1], radius = 0.5 } }"
# old text, new text, and key of the message
MISTAKES = [
    ("count = 9946", "count = -3", "cages.count"),
    ("count = 9946", "count = 1e4", "cages.count"),
    ("count = 9946", "cout = 9946", "cages.cout"),
    ("count = 9946", "", "cages"),
    ("count = 9946", "count = 9946\ncell_size = 1", "cages"),
    ('"affine"', '"afine"', "cages.embedding"),
    ('"affine"', '"mvc"\nsmoothing = 0.5', "cages.smoothing"),
    ('"affine"', '"cages"\nsmoothing = 1.5', "cages.smoothing"),
    ("young_modulus = 5e4", "young_modulus = 5e4\nstiffness = 1", "material"),
    ("density = 1000", "", "material.density"),
    (
        "density = 1000",
        'density = 1000\nlaw = "linear"\npoisson_ratio = 0.3',
        "material.poisson_ratio",
    ),
    ("density = 1000", 'density = 1000\nlaw = "linear"\nvolume = "log"', "material.volume"),
    ("[material]", "[materail]", "materail"),
    ("step = 0.0166667", 'step = "1e-3"', "time.step"),
    ("duration = 2.0", "duration = 0.001", "time.duration"),
    ("[0, 0, -9.81]", "[0, -9.81]", "gravity.acceleration.2"),
    ("[0, 0, -9.81]", "[0,\n 0,\n nan]", "gravity.acceleration.2"),
    ("[0, 0, -9.81]", '"down"', "gravity.acceleration"),
    ("[0, 3, 4]", "[0, 0.0, -0.0]", "obstacle.0.normal"),
    ("0.9], [1, 1, 1]", "0.9], [1, 1, 0.9]", "pin.0.region.box"),
    (SPHERE, "{}", "pin.1.region"),
    (SPHERE, "{ painted = [1, -2] }", "pin.1.region.painted"),
    (SPHERE, "{ painted = [1], relative = true }", "pin.1.region.relative"),
    ("normal = [0, 3, 4]", "", "obstacle.0"),
    ('"reflect"', '"reflect"\nfriction = 0.3', "obstacle.0"),
    ('"reflect"', '"reflect"\nstart = 2.0\nstop = 1.0', "obstacle.0.stop"),
    (
        '"reflect"',
        '"reflect"\npath = [{time = 2, by = [0,0,1]}, {time = 2, by = [0,0,0]}]',
        "obstacle.0.path",
    ),
    (
        "[solver]",
        "[[anchor]]\nregion = { painted = 'a.txt' }\npath = []\n[solver]",
        "anchor.0.path",
    ),
    ('"anderson"', '""', "solver.preset"),
    ('"orient"', '"simplify"', "mesh.prepare.1"),
    ('"orient"', "{}", "mesh.prepare.1"),
    ("simplify = 5000", "simplify = 3", "mesh.prepare.2.simplify"),
]


@pytest.mark.parametrize(("old", "new", "key"), MISTAKES, ids=[m[2] + m[1] for m in MISTAKES])
def test_a_mistake_is_named(tmp_path, old, new, key):
    (text,) = problems(tmp_path, changed(old, new))
    assert text.startswith(f"scene.toml: {key}: "), text


def test_a_stiffness_without_a_law_is_refused_with_the_remedy(tmp_path):
    (text,) = problems(tmp_path, changed("young_modulus = 5e4", "stiffness = 1"))
    assert 'give law = "linear"' in text
    text = changed("young_modulus = 5e4", 'law = "linear"\nstiffness = 1')
    assert load(tmp_path, text).material.poisson is None


def test_all_problems_at_once_each_with_its_line(tmp_path):
    text = SMALLEST.replace("100\n", "0\ncages.cell_size = -1\n").replace(
        "time.step = 0.01", "time.setp = 0.01"
    )
    assert problems(tmp_path, text) == [
        "scene.toml: cages.count: must be greater than 0, got 0",
        "scene.toml: cages.cell_size: must be greater than 0, got -1",
        "scene.toml: time.setp: unknown key, did you mean 'step'?",
    ]
    assert problems(tmp_path, text + "colour = 'red'\n") == [
        "scene.toml: colour: unknown key, valid: title, mesh, cages, material, time, body, part, "
        "start, gravity, obstacle, self_contact, pin, anchor, force, traction, pressure, solver, "
        "safety, output, picture"
    ]


def test_empty_file_names_every_required_table(tmp_path):
    missing = [
        f"scene.toml: {name}: required, but missing" for name in ("cages", "material", "time")
    ]
    assert problems(tmp_path, "") == missing


def test_text_and_folder_are_no_keys_of_the_file(tmp_path):
    found = problems(tmp_path, "text = ''\nfolder = '.'\n" + SMALLEST)
    assert [line.split(",")[0] for line in found] == [
        f"scene.toml: {key}: unknown key" for key in ("text", "folder")
    ]


def test_huge_integers_are_refused_not_converted(tmp_path):
    words = "must be less than 9223372036854775808"
    assert words in problems(tmp_path, changed("9946", "0x" + "F" * 6000))[0]
    assert "is not TOML" in problems(tmp_path, changed("9946", "9" * 5000))[0]
    assert "must be" in problems(tmp_path, changed("= 1000 ", "= 1" + "0" * 400))[0]
    (line,) = problems(
        tmp_path, SMALLEST.replace("0.01", "1e-50").replace("duration = 1", "duration = 1e50")
    )
    assert "time.duration: holds too many steps" in line


@pytest.mark.parametrize(
    ("table", "words"), [("title", "got a value too long to show"), ("force", "too many levels")]
)
def test_tables_of_many_levels_are_refused(tmp_path, table: str, words: str):
    text = f"time.integrator = 'static'\n{table}{3000 * '.a'} = 1\n"
    assert words in problems(tmp_path, text)[0]


# --- files that cannot be read


def test_broken_toml_names_the_line(tmp_path):
    (line,) = problems(tmp_path, changed("size = 0.3", "size 0.3"))
    assert line.startswith("scene.toml: is not TOML: ") and "line 6," in line
    (line,) = problems(tmp_path, "a = 1\nb = [1,\n")
    assert line.startswith("scene.toml: is not TOML: ") and line.endswith("(at end of document)")


def test_no_file_a_folder_and_no_utf8(tmp_path):
    with pytest.raises(InputError, match=r"none\.toml: no such scene file$"):
        load_scene(tmp_path / "none.toml")
    with pytest.raises(InputError, match=r"cannot be read: Is a directory$"):
        load_scene(tmp_path)
    (tmp_path / "latin.toml").write_bytes('title = "für"'.encode("latin-1"))
    with pytest.raises(InputError, match=r"latin\.toml: is not UTF-8 text \(byte 10\)$"):
        load_scene(tmp_path / "latin.toml")


# --- overrides


@pytest.mark.parametrize(
    ("override", "value_in", "value"),
    [
        ("time.step=1e-2", lambda s: s.time.steps, 200),
        ("mesh.source=models/my bunny.obj", lambda s: s.mesh.source, "models/my bunny.obj"),
        ("obstacle.0.restitution=0.5", lambda s: s.obstacle[0].restitution, 0.5),
        ("gravity.acceleration.2=1.62", lambda s: s.gravity.acceleration, (0, 0, 1.62)),
        ("mesh.prepare.4=union", lambda s: s.mesh.prepare[4:], ("union",)),
        (
            "pin.2.region.sphere={center=[0,0,0], radius=2}",
            lambda s: [p.region.sphere.radius for p in s.pin[2:]],
            [2],
        ),
        ("pin=[]", lambda s: s.pin, ()),
    ],
)
def test_override(tmp_path, override, value_in, value):
    assert value_in(load(tmp_path)) != value
    assert value_in(load(tmp_path, EXAMPLE, override)) == value


def test_overrides_make_tables_and_lists_and_the_last_one_wins(tmp_path):
    overrides = [
        "gravity.acceleration=[0, 0, 1]",
        "gravity.acceleration.2=2",
        "pin.0.region.box=[[0,0,0],[1,1,1]]",
    ]
    scene = load(tmp_path, SMALLEST, *overrides)
    assert scene.gravity.acceleration == (0, 0, 2)
    assert scene.pin[0].region.box == ((0, 0, 0), (1, 1, 1))


def swirl(distances: str, rates: str) -> str:
    return f"start.swirl={{axis=[0, 0, 1], distances={distances}, rates={rates}}}"


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("cages.count=-3", "scene.toml: cages.count: must be greater than 0, got -3"),
        ("gravity=-9.81", "scene.toml: gravity: must be a table, got -9.81"),
        ("time.step=5", "scene.toml: time.duration: must hold at least one step of 5 s"),
        ("cages.count", "--set cages.count: must read key.path=value"),
        ("cages..count=1", "--set cages..count=1: must read key.path=value"),
        ("mesh.size=[1", "--set mesh.size=[1: the value is not TOML"),
        ("mesh.size=1\nb=2", "--set mesh.size=1 b=2: must hold a single value"),
        ("mesh.size.x=1", "--set mesh.size.x=1: 'x' has no place in 0.3"),
        ("pin.3.region=1", "--set pin.3.region=1: 3 is no item of a list of 2"),
        (swirl("[1, 0]", "[0, 1]"), "start.swirl: must have ascending distances"),
        (swirl("[0, 1]", "[0]"), "start.swirl: has 2 distances and 1 rates"),
        (swirl("[]", "[]"), "start.swirl: has 0 distances and 0 rates"),
    ],
)
def test_a_bad_override_names_itself(tmp_path, override, expected):
    (line,) = problems(tmp_path, EXAMPLE, "title=x", override)
    assert expected in line


STATE = """
mesh = { source = "bunny_scan" }
cages = { count = 100 }
material = { young_modulus = 1e5, density = 1000 }
gravity = { acceleration = [0, 0, -9.81] }
time = { integrator = "static" }
pin = [{ region = { box = [[0, 0, 0], [1, 1, 1]] } }]
force = [{ region = { box = [[0, 0, 0], [1, 1, 1]] }, total = [1, 0, 0] }]
"""


def test_statics_that_stay_the_same_want_no_step_and_no_duration(tmp_path):
    time = load(tmp_path, STATE).time
    assert (time.steps, time.step, time.duration) == (1, 1.0, 1.0)
    again = load(tmp_path, STATE, "time.step=0.5").time
    assert (again.step, again.duration) == (0.5, 0.5)
    assert load(tmp_path, STATE, "time.duration=2").time.steps == 1
    assert load(tmp_path, STATE, "time.step=0.5", "time.duration=2").time.steps == 4


@pytest.mark.parametrize(
    "change",
    [
        "time.integrator=verlet",
        "force.0.start=1.0",
        "force.0.total={times = [0, 1], values = [[0, 0, 0], [1, 0, 0]]}",
        "anchor=[{region = {box = [[0, 0, 0], [1, 1, 1]]}, path = [{time = 1, by = [0, 0, 1]}]}]",
        'obstacle=[{shape = "sphere", center = [0, 0, 0], radius = 1, response = "penalty", stop '
        "= 2.0}]",
    ],
)
def test_what_changes_in_time_wants_both(tmp_path, change):
    assert problems(tmp_path, STATE, change) == [
        f"scene.toml: time.{key}: required, but missing" for key in ("step", "duration")
    ]
