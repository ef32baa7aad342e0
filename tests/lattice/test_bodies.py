"""Several bodies in a run each move as if they were alone, in any arrangement."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
import trimesh
from block_scene import GRAVITY, model_of, plane_at, play
from conftest import Run, run
from mpi4py import MPI
from one_process import input_error

import msmpetsc as package
from msmpetsc.build import build_model
from msmpetsc.errors import InputError
from msmpetsc.geometry.grid import CORNERS, BodyGrids
from msmpetsc.geometry.morton import LIMIT, encode_morton
from msmpetsc.results.comparison import compare
from msmpetsc.scene.reading import load_scene
from msmpetsc.study.metrics import distance_of_shapes, shape_error

H = 0.125
SPRINGS = {"young_modulus": 1e5, "density": 1000.0, "law": "linear"}
UPPER = {"box": [[0, 0, 0.8], [1, 1, 1]], "relative": True}
GROUND = plane_at(-0.06, response="penalty", stiffness=2e3)
# a ball that falls spinning on the ground; a bar in the same place that hangs and is
# pulled; a block, half of lead
BODIES: list[dict[str, Any]] = [
    {"mesh": {"source": "ball.ply"},
    "start": {"velocity": [0.5, 0, -1], "spin": [0, 3, 0], "scale": [1, 1, 0.9]}},
    {
        "mesh": {"source": "bar.ply",
        "prepare": [{"rotate": {"axis": [0, 0, 1], "degrees": 30.0}}]},
        "material": {"young_modulus": 3e5},
        "pin": [{"region": UPPER}],
        "force": [{"region": {"painted": [0, 1]}, "total": [2.0, 0, 0]}],
    },
    {
        "mesh": {"source": "block.ply", "base": [0.2, 0.1, 0.02]},
        "part": [{"region": {"box": [[0, 0, 0.5], [1, 1, 1]], "relative": True}, "density": 5e3}],
        "anchor": [{"region": UPPER, "path": [{"time": 0.05, "by": [0, 0.02, 0.03]}],
        "stop": 0.06}],
    },
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bodies")
    trimesh.creation.icosphere(subdivisions=2, radius=0.3).export(folder / "ball.ply")
    trimesh.creation.box(bounds=[[-0.13, -0.13, -0.4], [0.13, 0.13, 0.4]]).export(
        folder / "bar.ply"
    )
    trimesh.creation.box(extents=[0.5, 0.3, 0.3]).export(folder / "block.ply")
    return folder


def write(folder: Path, name: str, **tables: Any) -> Path:
    """Write a scene file; ``tables`` replace or extend its tables."""
    scene = {
        "cages": {"cell_size": H},
        "material": SPRINGS,
        "time": {"step": 0.01, "duration": 0.1},
        "gravity": GRAVITY,
        "obstacle": [GROUND],
        "solver": {"preset": "newton", "error": 1e-10},
    }
    path = folder / f"{name}.toml"
    path.write_text(tomli_w.dumps(scene | tables))
    return path


def alone(folder: Path, number: int, **tables: Any) -> Path:
    """Return the scene of a single body."""
    body = dict(BODIES[number])
    material = SPRINGS | body.pop("material", {})
    return write(folder, f"alone{number}", **body, material=material, **tables)


@pytest.mark.parametrize("integrator", ["implicit-euler", "verlet"])
def test_bodies_move_as_each_does_alone(folder: Path, integrator: str):
    """Bodies overlap from the start without contact, and each moves as it does alone.

    Obstacles, parts, pins, anchors, forces and starts take part. Each region belongs to a single
    body.
    """
    time = {"step": 0.01, "duration": 0.1, "integrator": integrator}
    time |= {"substep": 5e-4} if integrator == "verlet" else {}
    together, frames = play(write(folder, "three", body=BODIES, time=time))
    lattice, last = together.lattice, frames[-1]
    points = 0
    for number in range(len(BODIES)):
        model, expected = play(alone(folder, number, time=time))
        own = lattice.body == number
        np.testing.assert_array_equal(lattice.nodes[own], model.lattice.nodes)
        np.testing.assert_allclose(
            lattice.mass[own[: lattice.owned]], model.lattice.mass, rtol=1e-13
        )
        np.testing.assert_array_equal(lattice.pinned[own], model.lattice.pinned)
        moved = np.abs(expected[-1].position - model.lattice.nodes).max()
        assert moved > 0.01
        np.testing.assert_allclose(last.position[own], expected[-1].position, atol=1e-7 * moved)
        surface = expected[-1].surface
        np.testing.assert_allclose(
            last.surface[points : points + len(surface)], surface, atol=1e-7 * moved
        )
        points += len(surface)
    assert points == len(last.surface)


@pytest.fixture(scope="module")
def on_three(folder: Path) -> Path:
    """Return the result of all bodies on three ranks; its standard error lies beside it."""
    tables = {"time": {"step": 0.0025, "duration": 0.25}, "output": {"every": 4}}
    path = write(
        folder,
        "ranks",
        body=BODIES,
        solver={"preset": "newton-multigrid", "error": 1e-10},
        **tables,
    )
    done = run(
        3, "-m", "msmpetsc", "run", path, "-o", folder / "three.h5", "--frames", "24", status=0
    )
    (folder / "three.log").write_text(done.stderr)
    return folder / "three.h5"


def test_ranks_agree(on_three: Path):
    _, frames = play(on_three.with_name("ranks.toml"), "time.duration=0.06")
    with package.open(on_three) as result:
        rest, last = result.lattice.nodes[:], frames[-1].position
        np.testing.assert_allclose(
            result.frames.position[6], last, atol=1e-7 * np.abs(last - rest).max()
        )


def test_result_and_first_lines_say_whose_is_what(on_three: Path):
    said = on_three.with_name("three.log").read_text()
    assert [f"body.{number} of" in said for number in range(4)] == [True, True, True, False]
    assert "body.1.force.0 pulls" in said and "body.2.anchor.0 leads" in said
    with package.open(on_three) as result:
        body, of_point = result.lattice.body[:], result.surface.body[:]
        assert (np.diff(body) >= 0).all() and len(np.unique(body)) == len(np.unique(of_point)) == 3
        for ends in (
            result.lattice.springs[:],
            result.lattice.cells[:],
            of_point[result.surface.triangles[:]],
        ):
            whose = ends if ends.shape[1] == 3 else body[ends]
            assert (whose == whose[:, :1]).all()
        weights = result.embedding.tocoo()
        assert (body[weights.col] == of_point[weights.row]).all()
    assert 'Name="body"' in on_three.with_suffix(".xdmf").read_text()


def test_a_run_of_bodies_goes_on(folder: Path, on_three: Path, msmpetsc: Run):
    scene, part = on_three.with_name("ranks.toml"), folder / "part.h5"
    assert msmpetsc(1, "run", scene, "-o", part, "--frames", "20").returncode == 0
    resumed = msmpetsc(2, "run", scene, "--resume", part, "--frames", "24", "--force")
    assert resumed.returncode == 0 and "goes on after step 20" in resumed.stderr, resumed.stderr
    with package.open(part) as a, package.open(on_three) as b:
        compared = compare(a, b)
        moved = [field for field in compared.fields if field.name in ("position", "surface")]
        assert len(compared.times) == 7 and all(field.first_above(1e-7) is None for field in moved)


# Numbers of cells and nodes


def grids(*cells: tuple[int, int, int]) -> BodyGrids:
    """Return grids of so many cells along each axis, all at the origin."""
    return BodyGrids.covering([np.array([[0, 0, 0], sides], float) for sides in cells], 1.0)


def test_no_two_bodies_have_a_node_in_common_and_one_follows_the_other():
    several = grids((5, 3, 9), (8, 8, 8), (1, 1, 1))
    keys = []
    for number, grid in enumerate(several.grids):
        cells = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1).reshape(
            -1, 3
        )
        nodes = np.unique((cells[:, None] + CORNERS).reshape(-1, 3), axis=0)
        ijk = nodes + several.first(number)
        assert (several.body_of(ijk) == number).all()
        np.testing.assert_array_equal(several.node_positions(ijk), nodes.astype(float))
        keys.append(encode_morton(ijk))
        np.testing.assert_array_equal(np.argsort(keys[-1]), np.argsort(encode_morton(nodes)))
    for before, after in pairwise(keys):
        assert before.max() < after.min()


def test_coarse_cells_join_no_bodies_until_they_are_as_large():
    """The weights of a node on a grid coarsened ``level`` times reach only one body."""
    several = grids((7, 7, 7), (7, 7, 7), (7, 7, 7))
    # a body is a single cell at level 3
    for level in range(4):
        reached = [
            {*range((x := int(several.first(body)[0])) >> level, ((x + 7) >> level) + 2)}
            for body in range(3)
        ]
        assert not reached[0] & reached[1] and not reached[1] & reached[2]


def test_more_cells_than_can_be_numbered_are_refused():
    with pytest.raises(
        InputError,
        match="too small to number the cells of 40000 bodies: use at most 13 cells along a side",
    ):
        grids(*[(20, 20, 20)] * 40_000)
    assert grids(*[(13, 13, 13)] * 40_000).room * 40_000 <= LIMIT


def test_count_is_that_of_all_bodies(folder: Path):
    model = model_of(write(folder, "count", body=BODIES, cages={"count": 1500}))
    assert abs(len(model.lattice.cells) / 1500 - 1) <= 0.01
    with pytest.raises(InputError, match=r"cages\.max_cells = 100"):
        model_of(write(folder, "most", body=BODIES), "cages.max_cells=100")


# Tables of the scene and of bodies


def test_tables_of_the_scene_are_of_all_bodies(folder: Path):
    """The scene's pin holds nodes of any body in its region.

    The scene's start is the start of a body without its own.
    """
    bodies = [{"mesh": {"source": "bar.ply", "base": [x, 0, 0]}} for x in (0, 1)]
    bodies[1]["start"] = {"velocity": [0, 1.0, 0]}
    pin, part = (
        {"region": {"box": [[-1, -1, 0.7], [0.5, 1, 2]]}},
        {"region": {"box": [[-1, -1, -1], [2, 1, 0.4]]}},
    )
    tables = {
        "pin": [pin],
        "part": [{**part, "density": 3000.0}],
        "start": {"velocity": [1.0, 0, 0]},
    }
    model = model_of(write(folder, "all", body=bodies, **tables))
    lattice, (_, velocity) = model.lattice, model.start
    first = lattice.body == 0
    assert lattice.pinned[first].any() and not lattice.pinned[~first].any()
    assert (velocity[first & ~lattice.pinned] == [1, 0, 0]).all() and (
        velocity[~first] == [0, 1, 0]
    ).all()
    # the part lies in both bodies
    np.testing.assert_allclose(lattice.mass[first], lattice.mass[~first], rtol=1e-12)


def test_in_statics_each_body_must_be_held(folder: Path):
    tables = {"time": {"step": 1.0, "duration": 1.0, "integrator": "static"}, "obstacle": []}
    bodies = [BODIES[1], {"mesh": {"source": "block.ply"}}]
    with pytest.raises(
        InputError, match=r"a part of body\.1 of 80 nodes about \(.*\) m at rest is held by nothing"
    ):
        play(write(folder, "loose", body=bodies, **tables))
    bodies[1] |= {"pin": [{"region": UPPER}]}
    pulled = [bodies[0], {**bodies[1], "force": [{"region": UPPER, "function": "drag"}]}]
    with pytest.raises(InputError, match=r"body\.1\.force\.0 may be no function"):
        load_scene(write(folder, "pulled", body=pulled, **tables))
    _, frames = play(write(folder, "held", body=bodies, **tables))
    assert len(frames) == 2


def test_the_shape_of_each_body_counts_alone(folder: Path, msmpetsc: Run):
    """Bodies that fly apart keep their shapes; the body farthest from its shape gives the error."""
    bodies = [
        {"mesh": {"source": "block.ply"}, "start": {"velocity": [v, 0, 0]}} for v in (-1.0, 1.0)
    ]
    path = write(folder, "apart", body=bodies, gravity={"acceleration": [0, 0, 0]}, obstacle=[])
    assert msmpetsc(1, "run", path, "-o", folder / "apart.h5", "--frames", "5").returncode == 0
    with package.open(folder / "apart.h5") as run:
        assert shape_error(run, 5) < 1e-6
        rest, mass = run.lattice.nodes[:], run.lattice.mass[:]
        assert distance_of_shapes(run.frames.position[5], rest, mass) > 0.01


# Bad input

MISTAKES = [
    ({"mesh": {"source": "bar.ply"}}, "must give exactly one of mesh, body; has mesh and body"),
    (
        {"pin": [{"region": UPPER}]},
        "pin: may have no relative region beside [[body]], as pin.0 has",
    ),
    (
        {"part": [{"region": {"painted": [1]}, "density": 1.0}]},
        "as part.0 has: move it into [[body.part]]",
    ),
    ({"body": []}, "body: must have at least 1 item"),
]
IN_A_BODY = [
    ("body.1.mesh.sice=3", "body.1.mesh.sice: unknown key, did you mean 'size'?"),
    ("body.1.material={}", "body.1.material: needs "),
    (
        "body.1.material.stiffness=3",
        "body: may give stiffness only where material does, as body.1.material does",
    ),
    (
        "body.2.part.0.density=1e14",
        "body: has density of 1000 to 1e+14 in one run: a ratio above 1e+06",
    ),
    (
        "body.1.pin.0.region.box=[[7, 7, 7], [8, 8, 8]]",
        "body.1.pin.0.region holds no node of the lattice",
    ),
    (
        "body.1.force.0.region.painted=[99]",
        "body.1.force.0.region.painted: there is no point 99: the surface has 8",
    ),
    ("body.1.mesh.source=bare.ply", "body.1.mesh: mesh 'bare.ply' is no model"),
    ("body.1.mesh.source=../bar.ply", "is not in the scene's folder"),
    (
        'time={ step = 0.01, duration = 1, integrator = "static" }',
        "body: body.0.start may have no velocity, spin",
    ),
]


@pytest.mark.parametrize(("tables", "said"), MISTAKES)
def test_mistakes_of_the_scene(folder: Path, tables: dict, said: str):
    assert said in input_error(
        lambda: load_scene(write(folder, "wrong", **{"body": BODIES, **tables}))
    )


@pytest.mark.parametrize(("change", "said"), IN_A_BODY)
def test_mistakes_in_a_body_name_it(folder: Path, change: str, said: str):
    path = write(folder, "changed", body=BODIES)
    by_user = "../" not in change
    assert said in input_error(
        lambda: build_model(MPI.COMM_SELF, load_scene(path, [change], by_user=by_user))
    )
