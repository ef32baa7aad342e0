"""Scene files: what they mean, and that every mistake is named in one plain line."""

import json
import math
import tempfile
from pathlib import Path

import pytest
import tomli_w
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


def load(folder: Path, text: str = EXAMPLE, *overrides: str, presets: list[str] | None = None) -> Scene:
    path = folder / "scene.toml"
    path.write_bytes(text.encode())
    return load_scene(path, overrides, presets)


def problems(folder: Path, text: str, *overrides: str, presets: list[str] | None = None) -> list[str]:
    """The lines of the error, without the path of the temporary folder."""
    with pytest.raises(InputError) as caught:
        load(folder, text, *overrides, presets=presets)
    return str(caught.value).replace(f"{folder}/", "").split("\n")


def changed(old: str, new: str) -> str:
    assert EXAMPLE.count(old) == 1
    return EXAMPLE.replace(old, new)


# --- what a scene says


def test_the_example_means_what_it_says(tmp_path):
    scene = load(tmp_path)
    assert scene.title == "Bunny falls and leaps"
    assert scene.mesh.source == "bunny" and scene.mesh.size == 0.3 and scene.mesh.base is None
    rotate = {"rotate": {"axis": (0, 0, 2), "degrees": 90}}
    assert scene.mesh.prepare == ("repair", "orient", {"simplify": 5000}, rotate)
    assert scene.cages.count == 9946 and scene.cages.cell_size is None
    assert scene.material.young_modulus == 5e4 and scene.material.stiffness is None
    assert scene.time.steps == 120  # 2 s of 1/60 s
    assert scene.gravity.acceleration == (0, 0, -9.81)
    assert scene.obstacle[0].normal == pytest.approx((0, 0.6, 0.8), abs=1e-15)  # 3-4-5 triangle
    assert scene.pin[0].region.box == ((0, 0, 0.9), (1, 1, 1)) and scene.pin[0].region.relative
    assert scene.pin[1].region.sphere.radius == 0.5 and not scene.pin[1].region.relative
    assert scene.force[0].region.half_space.normal == (0, 0, 1)
    assert (scene.force[0].total, scene.force[0].start, scene.force[0].stop) == ((1, 0, 0), 0, 0.5)
    assert (scene.solver.preset, scene.solver.error, scene.solver.max_iterations) == ("anderson", 1e-3, None)
    assert not scene.output.surface
    assert (scene.text, scene.folder) == (EXAMPLE, tmp_path)


def test_defaults(tmp_path):
    scene = load(tmp_path, SMALLEST)
    assert scene.title == "" and scene.mesh.prepare == () and scene.mesh.size is None
    assert (scene.cages.method, scene.cages.embedding) == ("exact", "affine")
    assert (scene.cages.smoothing, scene.cages.max_cells) == (1.0, 5_000_000)
    assert scene.gravity is None and scene.obstacle == scene.pin == scene.force == ()
    assert scene.solver.preset == "newton" and scene.solver.error is None
    assert scene.output.surface


def test_line_ends_and_byte_order_mark_of_windows_editors(tmp_path):
    text = "\ufeff" + EXAMPLE.replace("\n", "\r\n")
    assert load(tmp_path, text).cages.count == 9946
    assert problems(tmp_path, text.replace("9946", "0")) == ["scene.toml: cages.count: must be > 0, got 0 (line 9)"]


@given(st.tuples(*3 * [st.floats(allow_nan=False, allow_infinity=False)]).filter(any))
@settings(max_examples=50, deadline=None)
def test_normals_are_unit_vectors_at_any_magnitude(normal):
    override = f"obstacle=[{{shape='plane', point=[0,0,0], normal={list(normal)}}}]"
    with tempfile.TemporaryDirectory() as folder:
        scene = load(Path(folder), SMALLEST, override)
    assert math.hypot(*scene.obstacle[0].normal) == pytest.approx(1, abs=1e-15)
    longest = max(range(3), key=lambda i: abs(normal[i]))
    assert scene.obstacle[0].normal[longest] * normal[longest] > 0


def test_every_key_is_described_with_its_unit():
    schema = SceneFile.model_json_schema()
    tables = [schema, *schema["$defs"].values()]
    assert len(tables) > 10
    for table in tables:
        for name, field in table["properties"].items():
            assert field["description"], name
            numeric = '"number"' in json.dumps(field) or '"integer"' in json.dumps(field)
            assert not numeric or "[" in field["description"], name


# --- one mistake, one line

MISTAKES = [
    ("count = 9946", "count = -3", "cages.count: must be > 0, got -3 (line 9)"),
    ("count = 9946", "count = 1e4", "cages.count: must be a whole number, got 10000.0 (line 9)"),
    ("count = 9946", "cout = 9946", "cages.cout: unknown key, did you mean 'count'? (line 9)"),
    ("count = 9946", "", "cages: must give exactly one of count, cell_size; has none (line 8)"),
    (
        "count = 9946",
        "count = 9946\ncell_size = 1",
        "cages: must give exactly one of count, cell_size; has count and cell_size (line 8)",
    ),
    ('"affine"', '"afine"', "cages.embedding: unknown value \"afine\", did you mean 'affine'? (line 10)"),
    ('"affine"', '"mvc"\nsmoothing = 0.5', 'cages.smoothing: is for embedding = "cages" only, got 0.5 (line 11)'),
    ('"affine"', '"cages"\nsmoothing = 1.5', "cages.smoothing: must be <= 1, got 1.5 (line 11)"),
    (
        "young_modulus = 5e4",
        "young_modulus = 5e4\nstiffness = 1",
        "material: must give exactly one of young_modulus, stiffness; has young_modulus and stiffness (line 12)",
    ),
    ("density = 1000", "", "material.density: required, but missing (line 12)"),
    (
        "density = 1000",
        "density = 1000\npoisson_ratio = 0.3",
        'material.poisson_ratio: is for law = "neo-hookean" only, got 0.3 (line 15)',
    ),
    ("[material]", "[materail]", "materail: unknown key, did you mean 'material'? (line 12)"),
    ("step = 0.0166667", 'step = "1e-3"', 'time.step: must be a number, got "1e-3" (line 17)'),
    ("duration = 2.0", "duration = 0.001", "time.duration: must hold at least one step of 0.0166667 s, got 0.001"),
    ("[0, 0, -9.81]", "[0, -9.81]", "gravity.acceleration: must have 3 items, got [0, -9.81] (line 21)"),
    ("[0, 0, -9.81]", "[0,\n 0,\n nan]", "gravity.acceleration.2: must be a finite number, got nan (line 21)"),
    ("[0, 0, -9.81]", '"down"', 'gravity.acceleration: must be a list, got "down" (line 21)'),
    ("[0, 3, 4]", "[0, 0.0, -0.0]", "obstacle.0.normal: must not be the zero vector, got [0, 0.0, -0.0] (line 26)"),
    (
        "0.9], [1, 1, 1]",
        "0.9], [1, 1, 0.9]",
        "pin.0.region.box: must have each coordinate of the first corner below that of the second, got",
    ),
    (
        "{ sphere = { center = [0, 0, 1], radius = 0.5 } }",
        "{}",
        "pin.1.region: must give exactly one of box, sphere, half_space, painted; has none (line 33)",
    ),
    (
        "{ sphere = { center = [0, 0, 1], radius = 0.5 } }",
        "{ painted = [1, -2] }",
        "pin.1.region.painted: must be a list of point numbers, from 0, or the name of a file that has them, "
        "got [1, -2]",
    ),
    (
        "{ sphere = { center = [0, 0, 1], radius = 0.5 } }",
        "{ painted = [1], relative = true }",
        "pin.1.region.relative: has no meaning for painted points, got true (line 33)",
    ),
    ("density = 1000", "density = 1000\nstiffening = 3", 'material.stiffening: is for law = "stiffening" only, got 3'),
    ("normal = [0, 3, 4]", "", 'obstacle.0: needs normal for shape = "plane"'),
    ('"reflect"', '"reflect"\nfriction = 0.3', "obstacle.0: has friction, which is for 'penalty' only"),
    ('"reflect"', '"reflect"\nstart = 2.0\nstop = 1.0', "obstacle.0.stop: must be > start = 2, got 1.0 (line 29)"),
    (
        '"reflect"',
        '"reflect"\npath = [{ time = 2.0, by = [0, 0, 1] }, { time = 2.0, by = [0, 0, 0] }]',
        "obstacle.0.path: must have ascending times",
    ),
    (
        "[solver]",
        "[[anchor]]\nregion = { painted = 'a.txt' }\npath = []\n[solver]",
        "anchor.0.path: must have at least 1 item",
    ),
    ('"anderson"', '""', "solver.preset: must not be empty (line 41)"),
    ('"bunny"', '""', "mesh.source: must not be empty (line 4)"),
    ('"orient"', '"simplify"', 'mesh.prepare.1: needs a value: { simplify = ... }, got "simplify" (line 5)'),
    ('"orient"', "{}", "mesh.prepare.1: must give exactly one of simplify, rotate; has none (line 5)"),
    ("simplify = 5000", "simplify = 3", "mesh.prepare.2.simplify: must be >= 4, got 3 (line 5)"),
    ("degrees = 90", "angle = 90", "mesh.prepare.3.rotate.degrees: required, but missing (line 5)"),
]


@pytest.mark.parametrize(("old", "new", "expected"), MISTAKES, ids=[m[2].split(" ")[0] + m[1] for m in MISTAKES])
def test_a_mistake_is_named(tmp_path, old, new, expected):
    told = problems(tmp_path, changed(old, new))
    assert f"scene.toml: {expected}" in "\n".join(told)
    assert len(told) == 1 or "angle" in new  # that one is a missing and an unknown key


def test_all_problems_at_once_each_with_its_line(tmp_path):
    text = SMALLEST.replace("100\n", "0\ncages.cell_size = -1\n").replace("time.step = 0.01", "time.setp = 0.01")
    assert problems(tmp_path, text + "colour = 'red'\n") == [
        "scene.toml: cages: must give exactly one of count, cell_size; has count and cell_size (line 2)",
        "scene.toml: cages.count: must be > 0, got 0 (line 2)",
        "scene.toml: cages.cell_size: must be > 0, got -1 (line 3)",
        "scene.toml: time.setp: unknown key, did you mean 'step'? (line 6)",
        "scene.toml: colour: unknown key, valid: title, mesh, cages, material, time, body, part, start, "
        "gravity, obstacle, self_contact, pin, anchor, force, solver, safety, output, budget, picture (line 8)",
    ]


def test_empty_file_names_every_required_table(tmp_path):
    missing = [f"scene.toml: {name}: required, but missing" for name in ("cages", "material", "time")]
    assert problems(tmp_path, "") == ["scene.toml: must give exactly one of mesh, body; has none", *missing]


def test_text_and_folder_are_no_keys_of_the_file(tmp_path):
    found = problems(tmp_path, "text = ''\nfolder = '.'\n" + SMALLEST)
    assert [line.split(",")[0] for line in found] == [
        "scene.toml: text: unknown key",
        "scene.toml: folder: unknown key",
    ]


def test_presets_are_checked_against_the_list_given(tmp_path):
    text = changed('"anderson"', '"andersen"')
    assert load(tmp_path, text).solver.preset == "andersen"
    assert load(tmp_path, presets=["paper", "anderson"]).solver.preset == "anderson"
    assert problems(tmp_path, text, presets=["paper", "anderson"]) == [
        "scene.toml: solver.preset: unknown value \"andersen\", did you mean 'anderson'? (line 41)"
    ]


def test_huge_integers_are_refused_not_converted(tmp_path):
    assert "must be < 9223372036854775808" in problems(tmp_path, changed("9946", "0x" + "F" * 6000))[0]
    assert "too many digits" in problems(tmp_path, changed("9946", "9" * 5000))[0]
    assert "must be a number" in problems(tmp_path, changed("= 1000 ", "= 1" + "0" * 400))[0]
    (line,) = problems(tmp_path, SMALLEST.replace("0.01", "1e-50").replace("duration = 1", "duration = 1e50"))
    assert "time.duration: holds too many steps" in line


# --- files that cannot be read


def test_broken_toml_names_the_line(tmp_path):
    (line,) = problems(tmp_path, changed("size = 0.3", "size 0.3"))
    assert line.startswith("scene.toml: is not TOML: ") and "line 6," in line
    (line,) = problems(tmp_path, "a = 1\nb = [1,\n")
    assert line.startswith("scene.toml: is not TOML: ") and line.endswith("(at the end, line 2)")
    assert problems(tmp_path, "a = " + "[" * 100_000) == ["scene.toml: is nested too deeply"]


def test_no_file_a_folder_and_no_utf8(tmp_path):
    with pytest.raises(InputError, match=r"none\.toml: no such scene file$"):
        load_scene(tmp_path / "none.toml")
    with pytest.raises(InputError, match=r"is a folder, not a scene file$"):
        load_scene(tmp_path)
    (tmp_path / "latin.toml").write_bytes('title = "für"'.encode("latin-1"))
    with pytest.raises(InputError, match=r"latin\.toml: is not UTF-8 text \(byte 10\)$"):
        load_scene(tmp_path / "latin.toml")


# --- overrides


@pytest.mark.parametrize(
    ("override", "look", "value"),
    [
        ("time.step=1e-2", lambda s: s.time.steps, 200),
        ("mesh.source=models/my bunny.obj", lambda s: s.mesh.source, "models/my bunny.obj"),
        ("obstacle.0.restitution=0.5", lambda s: s.obstacle[0].restitution, 0.5),
        ("gravity.acceleration.2=1.62", lambda s: s.gravity.acceleration, (0, 0, 1.62)),
        ("mesh.prepare.4=union", lambda s: s.mesh.prepare[4:], ("union",)),
        ("pin.2.region.sphere={center=[0,0,0], radius=2}", lambda s: [p.region.sphere.radius for p in s.pin[2:]], [2]),
        ("pin=[]", lambda s: s.pin, ()),
    ],
)
def test_override(tmp_path, override, look, value):
    assert look(load(tmp_path)) != value
    assert look(load(tmp_path, EXAMPLE, override)) == value


def test_overrides_make_tables_and_lists_and_the_last_one_wins(tmp_path):
    overrides = ["gravity.acceleration=[0, 0, 1]", "gravity.acceleration.2=2", "pin.0.region.box=[[0,0,0],[1,1,1]]"]
    scene = load(tmp_path, SMALLEST, *overrides)
    assert scene.gravity.acceleration == (0, 0, 2)
    assert scene.pin[0].region.box == ((0, 0, 0), (1, 1, 1))


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("cages.count=-3", "scene.toml: cages.count: must be > 0, got -3 (--set cages.count=-3)"),
        (
            "gravity=-9.81",
            "scene.toml: gravity: must be a table, { acceleration = [0, 0, -9.81] }, got -9.81 (--set gravity=-9.81)",
        ),
        ("cages.cout=3", "scene.toml: cages.cout: unknown key, did you mean 'count'? (--set cages.cout=3)"),
        ("pin.0=3", "scene.toml: pin.0: must be a table, got 3 (--set pin.0=3)"),
        (
            "cages.cell_size=1",
            "scene.toml: cages: must give exactly one of count, cell_size; has count and cell_size "
            "(--set cages.cell_size=1; in place of all keys there: --set 'cages={cell_size=1}')",
        ),
        ("time.step=5", "scene.toml: time.duration: must hold at least one step of 5 s, got 2.0 (--set time.step=5)"),
        ("solver.error=1e-3x", 'scene.toml: solver.error: must be a number, got "1e-3x" (--set solver.error=1e-3x)'),
        ("cages.count", "--set cages.count: must read key.path=value"),
        ("cages.count=", "--set cages.count=: must read key.path=value"),
        ("cages..count=1", "--set cages..count=1: must read key.path=value"),
        ("mesh.size=[1", "--set mesh.size=[1: the value is not TOML"),
        ("mesh.size=1\nb=2", "--set mesh.size=1 b=2: must hold a single value"),
        ("mesh.size.x=1", "--set mesh.size.x=1: 'x' has no place in 0.3, which is no table or list"),
        ("pin.3.region=1", "--set pin.3.region=1: 3 is no item of a list of 2: the next would be 2"),
        ("pin.first=1", "--set pin.first=1: 'first' is no item of a list of 2: the next would be 2"),
    ],
)
def test_a_bad_override_names_itself(tmp_path, override, expected):
    assert problems(tmp_path, EXAMPLE, "title=x", override) == [expected]


def test_an_innocent_override_is_not_blamed(tmp_path):
    assert problems(tmp_path, changed("9946", "0"), "cages.max_cells=9") == [
        "scene.toml: cages.count: must be > 0, got 0 (line 9)"
    ]
    (line,) = problems(tmp_path, changed("count = 9946", ""), "cages.max_cells=9")
    assert line.endswith("has none (line 8)")


# --- anything at all

KEYS = st.sampled_from(sorted({word for word in EXAMPLE.split() if word.isidentifier()})) | st.text(max_size=4)
SCALARS = (
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats()
    | st.text(max_size=4)
    | st.sampled_from(["merge", "simplify", "plane", "cages"])
    | st.dates()
)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4), max_leaves=12
)


def only_input_errors(text: str, *overrides: str) -> None:
    """Load; every line of an error must name the file or the override, and none may speak of pydantic."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            scene = load(Path(folder), text, *overrides)
        except InputError as error:
            for line in str(error).split("\n"):
                assert line.startswith((f"{folder}/scene.toml: ", "--set ")), line
                assert "Input should" not in line and "pydantic" not in line and "is not valid" not in line
        else:
            assert load(Path(folder), scene.text) == scene


PATHS = [
    "title", "mesh", "mesh.source", "mesh.prepare", "mesh.prepare.2", "mesh.prepare.3.rotate", "mesh.base", "cages",
    "cages.count", "cages.cell_size", "cages.smoothing", "material", "time.step", "time.duration", "gravity",
    "gravity.acceleration", "gravity.acceleration.1", "obstacle", "obstacle.0.normal", "obstacle.0.restitution",
    "pin", "pin.0", "pin.0.region", "pin.0.region.box", "pin.1.region.sphere.radius", "force.0.stop", "solver",
    "solver.error", "output.surface",
]  # fmt: skip


@given(st.sampled_from(PATHS), VALUES)
@settings(max_examples=150, deadline=None)
def test_any_value_anywhere_loads_or_is_an_input_error(path, value):
    only_input_errors(EXAMPLE, f"{path}={_inline(value)}")


def _inline(value) -> str:
    """The value in TOML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(tomli_w.dumps({key: 0})[:-2] + _inline(item) for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_inline, value)) + "]"
    return tomli_w.dumps({"a": value})[4:-1]


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
    assert (again.step, again.duration) == (0.5, 0.5) and load(tmp_path, STATE, "time.duration=2").time.steps == 1
    assert load(tmp_path, STATE, "time.step=0.5", "time.duration=2").time.steps == 4


@pytest.mark.parametrize(
    "change",
    [
        "time.integrator=verlet",
        "force.0.start=1.0",
        "force.0.total={times = [0, 1], values = [[0, 0, 0], [1, 0, 0]]}",
        "anchor=[{region = {box = [[0, 0, 0], [1, 1, 1]]}, path = [{time = 1, by = [0, 0, 1]}]}]",
        'obstacle=[{shape = "sphere", center = [0, 0, 0], radius = 1, response = "penalty", stop = 2.0}]',
    ],
)
def test_what_changes_in_time_wants_both(tmp_path, change):
    assert problems(tmp_path, STATE, change) == [
        f"scene.toml: time.{key}: required, but missing (line 6)" for key in ("step", "duration")
    ]
