"""Messages at the start of a run: nodes of tables, tables without effect, unusual sizes."""

import logging
import re
from pathlib import Path

import pytest
from block_scene import CELL, YOUNG, block_scene, solid_of
from conftest import run
from mpi4py import MPI
from one_process import answers_on

from msmpetsc.app.summary import log_model
from msmpetsc.build import Model, build_model, read_bodies
from msmpetsc.errors import InputError
from msmpetsc.scene.reading import load_scene
from msmpetsc.scene.toml import toml_value

TIME = {"step": 0.01, "duration": 0.1}
# the regions have 15 and 45 of 75 nodes
LEFT, LEFT_HALF = (
    {"box": [[0, 0, 0], [0.01, 0.5, 0.25]]},
    {"box": [[0, 0, 0], [0.26, 0.5, 0.25]]},
)
# 15 nodes
RIGHT = {"box": [[0.49, 0, 0], [0.5, 0.5, 0.25]]}
UP, ASIDE = [{"time": 0.05, "by": [0, 0, 0.02]}], [{"time": 0.05, "by": [0.01, 0, 0]}]


def build(folder: Path, **tables) -> Model:
    # two cells of springs across are too stiff and cause a warning
    material = solid_of(YOUNG)
    scene = load_scene(block_scene(folder, **{"time": TIME, "material": material} | tables))
    return build_model(MPI.COMM_SELF, scene)


@pytest.fixture
def heard(caplog):
    """Return the function heard() -> log messages since its last call, with their levels."""
    caplog.set_level(logging.INFO, "msmpetsc")

    def since() -> list[tuple[str, str]]:
        # the command line renames these levels
        names = {
            logging.WARNING: "WARNING",
            logging.INFO: "INFO",
        }
        lines = [(names[record.levelno], record.getMessage()) for record in caplog.records]
        caplog.clear()
        return lines

    return since


def force(region: dict, **more) -> dict:
    return {"region": region, "total": [0, 0, -1.0]} | more


HALF_PIN = {"pin": [{"region": LEFT_HALF}]}
LED = {"region": LEFT, "path": UP}
HALF_LED = LED | {"region": LEFT_HALF}


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        (HALF_PIN | {"force": [force(LEFT)]}, "moves nothing"),
        ({"anchor": [HALF_LED], "force": [force(LEFT)]}, "moves nothing"),
        # the anchor holds the nodes as long as the force acts
        (
            {"anchor": [HALF_LED | {"stop": 0.05}], "force": [force(LEFT, stop=0.05)]},
            "moves nothing",
        ),
        ({"anchor": [LED, LED | {"path": ASIDE}]}, r"anchor\.1: .* it leads none"),
        (HALF_PIN | {"anchor": [LED]}, r"anchor\.0: .* it leads none"),
    ],
)
def test_a_table_on_held_nodes_alone_is_refused(tmp_path, tables, message):
    with pytest.raises(InputError, match=message):
        build(tmp_path, **tables)


@pytest.mark.parametrize(
    ("tables", "held"),
    [
        ({"pin": [{"region": LEFT}], "force": [force(LEFT_HALF)]}, 15),
        ({"anchor": [{"region": LEFT, "path": UP, "stop": 0.05}], "force": [force(LEFT)]}, 0),
        ({"pin": [{"region": LEFT}], "force": [force(LEFT, total=[0, 0, 0])]}, 15),
    ],
    ids=["partly pinned", "let go before it ends", "switched off"],
)
def test_a_force_that_finds_a_free_node_is_not(tmp_path, heard, tables, held):
    words = build(tmp_path, **tables).node_counts[-1]
    assert (
        words.startswith("force.0 pulls ")
        and (f"({held} of them held)" in words) == bool(held)
        and heard() == []
    )


def test_nodes_that_two_anchors_want_are_warned_of(tmp_path, heard):
    # 25 and 5 nodes
    low, low_edge = (
        {"box": [[0, 0, 0], [0.5, 0.5, 0.01]]},
        {"box": [[0, 0, 0], [0.5, 0.01, 0.01]]},
    )
    build(
        tmp_path,
        anchor=[{"region": LEFT, "path": UP}, {"region": low, "path": ASIDE}],
        pin=[{"region": low_edge}],
    )
    first, second = (line for level, line in heard() if level == "WARNING")
    assert re.findall(r"\d+", first) == ["0", "15", "1", "0"] and re.findall(r"\d+", second) == [
        "1",
        "25",
        "5",
        "4",
    ]


def test_pins_may_overlap(tmp_path, heard):
    model = build(tmp_path, pin=[{"region": LEFT_HALF}, {"region": LEFT}])
    assert heard() == [] and model.lattice.pinned.sum() == 45


@pytest.mark.parametrize(
    ("side", "mesh", "words"),
    [
        (300.0, {}, ["300 m long", "millimetres"]),
        (0.0005, {}, ["0.0005 m long", "another unit"]),
        (20.0, {}, []),
        (0.001, {}, []),
        (300.0, {"size": 30.0}, []),
    ],
)
def test_a_body_of_an_odd_size_is_warned_of_before_it_is_filled(tmp_path, heard, side, mesh, words):
    path = block_scene(
        tmp_path, [side, side / 2, side / 2], mesh={"source": "scene.ply"} | mesh, time=TIME
    )
    read_bodies(MPI.COMM_SELF, load_scene(path))
    lines = heard()
    assert len(lines) == (len(words) > 0) and all(word in lines[0][1] for word in words)


@pytest.mark.parametrize("ranks", [1, 2])
def test_the_first_lines_say_what_a_run_is_of_and_the_last_what_it_left(tmp_path, ranks):
    scene = block_scene(
        tmp_path, time={"step": 0.01, "duration": 0.02}, pin=[{"region": LEFT}],
        anchor=[{"region": RIGHT, "path": UP, "stop": 0.01}], force=[force(LEFT_HALF)],
    )  # fmt: skip
    out = tmp_path / "out" / "x.h5"
    done = run(
        ranks,
        "-m",
        "msmpetsc.cli.main",
        "run",
        scene,
        "-o",
        out,
        "--measure",
        tmp_path / "cost.json",
        status=0,
    )
    before, after = done.stderr.split("frame 0/2")
    counts = (
        "32 cells",
        "75 nodes (15 pinned)",
        f"{ranks} rank",
        "anchor.0 leads 15",
        "force.0 pulls 45 nodes (15",
    )
    assert all(words in before for words in ("0.5 x 0.5 x 0.25 m", *counts)), before
    left = out, out.with_suffix(".xdmf"), tmp_path / "cost.json"
    assert all(f"{path} (" in after for path in left) and ".png" not in after, after


def test_masses_of_mesh_and_lattice_stand_side_by_side(tmp_path, heard):
    """The log has the masses of mesh and lattice.

    4 x 4 x 2 cells of 1/8 m cover a block of 0.45 x 0.45 x 0.2 m. Half of them have half the
    density.
    """
    half = {"region": {"box": [[0, 0, 0], [0.25, 1, 1]]}, "density": 500.0}
    path = block_scene(tmp_path, [0.45, 0.45, 0.2], time=TIME, part=[half])
    for boundary, told in {
        "whole": "closed mesh of 0.0405 m^3, 30.37 kg; lattice of 0.0625 m^3, 46.88 kg",
        # 0.25 m of 0.45 m have half the density
        "fill": "closed mesh of 0.0405 m^3, 29.25 kg; lattice of 0.0405 m^3, 29.25 kg",
    }.items():
        scene = load_scene(path, [f'cages.boundary="{boundary}"'])
        log_model(MPI.COMM_SELF, build_model(MPI.COMM_SELF, scene))
        thick = "1.6 cells thick, 1.6 at its thin tenth"
        assert ("INFO", f"body of 0.45 x 0.45 x 0.2 m; {thick}; {told}") in heard()


def test_ranks_refuse_and_warn_as_one(tmp_path):
    """All ranks refuse and warn alike, although the nodes of a region may lie on one rank."""
    block_scene(tmp_path, time=TIME)
    tables = {
        "none is free": {"pin.0.region": LEFT_HALF, "force.0": force(LEFT)},
        "it leads none": {
            "anchor.0": {"region": LEFT_HALF, "path": UP},
            "anchor.1": {"region": LEFT, "path": ASIDE},
        },
        "which it does not lead": {
            "anchor.0": {"region": LEFT_HALF, "path": UP},
            "pin.0.region": LEFT,
        },
    }
    commands = [
        ["run", str(tmp_path / "scene.toml"), "-o", str(tmp_path / f"{number}.h5"), "--frames", "1"]
        + [word for key, value in given.items() for word in ("--set", f"{key}={toml_value(value)}")]
        for number, given in enumerate(tables.values())
    ]
    for words, status, answers in zip(tables, (2, 2, 0), answers_on(2, commands), strict=True):
        assert [given for given, _ in answers] == [status] * 2 and answers[1][1] == "", answers
        assert answers[0][1].count(words) == 1


def test_any_number_of_ranks_tells_the_same_thickness(tmp_path):
    """The log of a strip of half a cell, turned by 30 degrees, does not depend on the ranks."""
    turned = {"rotate": {"axis": [0, 1, 0], "degrees": 30}}
    solid = solid_of(YOUNG)
    path = block_scene(tmp_path, [1, 0.25, CELL / 2], time=TIME, material=solid)
    mesh = {"source": "scene.ply", "prepare": [turned]}
    told = []
    for ranks in (1, 2):
        words = "run", path, "-o", tmp_path / "x.h5", "--overwrite", "--frames", "1"
        ((_, text), *others) = answers_on(ranks, [[*words, "--set", f"mesh={toml_value(mesh)}"]])[0]
        assert all(text == "" for _, text in others)
        told.append([line for line in text.splitlines() if "thick" in line or "theory" in line])
    assert told[0] == told[1] and len(told[0]) == 2, told
    assert "so thin, and askew to the grid, that it bends by about 0.21 of theory" in told[0][0]
    assert "0.5 cells thick, 0.5 at its thin tenth" in told[0][1]
