"""``msmpetsc new``: its measures of a mesh, and a scene that runs at once."""

import json
import os
import shlex
import shutil
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import ROOT, python
from one_process import command_error, status_of
from surfaces import surface_of

import msmpetsc
from msmpetsc.cli.commands.new import SURER, measured, unit_of, uprightness
from msmpetsc.geometry.surface import examine
from msmpetsc.scene.key_table import SCHEMA_FILE, json_schema
from msmpetsc.scene.reading import load_scene


def chair(upwards: int, back: int) -> trimesh.Trimesh:
    """Return a chair of boxes on y (1) or z (2).

    Its back points to an end (1) or the opposite end (-1).
    """
    # seat and back
    boxes = [[[0, 0.4, 0], [0.45, 0.45, 0.45]], [[0, 0.45, 0], [0.45, 0.9, 0.05]]]
    boxes += [[[x, 0, z], [x + 0.05, 0.4, z + 0.05]] for x in (0, 0.4) for z in (0, 0.4)]
    mesh = trimesh.util.concatenate([trimesh.creation.box(bounds=box) for box in boxes])
    turns = [trimesh.transformations.rotation_matrix(np.pi, [0, 1, 0])] * (back < 0)
    turns += [trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])] * (upwards == 2)
    for turn in turns:
        mesh.apply_transform(turn)
    return mesh


def table(upwards: int) -> trimesh.Trimesh:
    """A table, which lies as well on its top, and on its sides."""
    boxes = [[[0, 0.7, 0], [1.2, 0.75, 0.8]]]
    boxes += [[[x, 0, z], [x + 0.06, 0.7, z + 0.06]] for x in (0, 1.14) for z in (0, 0.74)]
    mesh = trimesh.util.concatenate([trimesh.creation.box(bounds=box) for box in boxes])
    return mesh.apply_transform(
        trimesh.transformations.rotation_matrix(np.pi / 2 * (upwards == 2), [1, 0, 0])
    )


@pytest.mark.parametrize("axis", [1, 2])
def test_furniture_stands_on_its_feet(axis: int):
    for mesh in (chair(axis, 1), chair(axis, -1), table(axis)):
        assert (uprightness(surface_of(mesh), 1) > uprightness(surface_of(mesh), 2) + SURER) == (
            axis == 1
        )


@pytest.mark.parametrize(
    ("suffix", "words", "up"), [("stl", [], "z"), ("stl", ["--up", "y"], "y"), ("glb", [], "y")]
)
def test_new_takes_z_for_upwards_or_what_is_said(suffix, words, up, tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    trimesh.creation.box([0.1, 0.2, 0.1]).export(f"box.{suffix}")
    with caplog.at_level("INFO", logger="msmpetsc"):
        assert status_of("new", "my.toml", "--mesh", f"box.{suffix}", *words) == 0
    assert f"{up} is taken for upwards" in caplog.text
    assert "the file is taken to be in m, its longest side as 0.2 m" in caplog.text
    turns = [step for step in load_scene("my.toml").mesh.prepare if "rotate" in step]
    assert len(turns) == (up == "y")
    assert "upwards" in Path("my.toml").read_text()


@pytest.mark.parametrize(
    ("side", "unit"), [(0.3, 1.0), (15.0, 1.0), (150.0, 1e-3), (1e-5, None), (1e6, None)]
)
def test_the_unit_is_the_one_in_which_the_body_has_a_usual_size(side: float, unit: float | None):
    assert unit_of(side) == unit


def test_parts_are_measured_by_their_area_and_thickness_by_rays():
    boxes = [
        trimesh.creation.box([1, 1, 1]),
        trimesh.creation.box([2, 2, 2]).apply_translation([5, 0, 0]),
    ]
    two = surface_of(trimesh.util.concatenate(boxes))
    # 24 of 30 m^2, and 6
    assert measured(two, examine(two), "z").parts == pytest.approx([0.8, 0.2])
    cube = surface_of(trimesh.creation.box([6, 6, 6]))
    assert measured(cube, examine(cube), "z").thickness.thin == pytest.approx(6)


BODIES = {
    "ball": (trimesh.creation.icosphere(subdivisions=2, radius=0.1), ["obstacle"], "to be in m"),
    "mm": (trimesh.creation.icosphere(subdivisions=2, radius=40), ["obstacle"], "to be in mm"),
    "bar": (trimesh.creation.box([0.1, 0.5, 0.1]), ["pin"], "to be in m"),
    "inwards": (trimesh.creation.box([0.1, 0.1, 0.1]), ["obstacle"], "wound inwards"),
}


@pytest.mark.parametrize("name", BODIES)
def test_a_first_scene_runs_at_once(name: str, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    mesh, tables, words = BODIES[name]
    if name == "inwards":
        mesh.invert()
    mesh.export(f"{name}.stl")
    assert status_of("new", "my.toml", "--mesh", f"{name}.stl") == 0
    assert "msmpetsc run my.toml" in capsys.readouterr().out
    text = Path("my.toml").read_text()
    assert text.startswith(f"#:schema {SCHEMA_FILE}\n") and words in text
    assert json.loads(Path(SCHEMA_FILE).read_text()) == json.loads(json.dumps(json_schema()))
    scene = load_scene("my.toml")
    assert [kind for kind in ("obstacle", "pin") if getattr(scene, kind)] == tables
    size = scene.mesh.size
    assert size is not None and 0.01 < size < 1
    assert status_of("run", "my.toml", "-o", "my.h5", "--set", "cages.count=150", "--quiet") == 0
    with msmpetsc.open("my.h5") as run:
        moved = np.linalg.norm(run.frames.position[-1] - run.lattice.nodes[:], axis=1).max()
        fallen = 0.2 * size if tables == ["obstacle"] else 0.05 * size
        assert fallen * 0.5 < moved < size, "it falls on the ground, or its end sinks"


def test_what_is_found_of_a_mesh_is_said(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    box = trimesh.creation.box([0.1, 0.1, 0.1])
    box.invert()
    trimesh.util.concatenate([box, box.copy().apply_translation([0.3, 0, 0])]).export("two.ply")
    assert status_of("new", "two.toml", "--mesh", "two.ply") == 0
    told = capsys.readouterr().err
    assert (
        "24 triangles, closed, 2 parts, the largest of 50% of the area" in told
        and "wound inwards" in told
    )
    hole = trimesh.Trimesh(box.vertices, box.faces[2:], process=False)
    hole.export("open.ply")
    assert status_of("new", "open.toml", "--mesh", "open.ply") == 0
    assert "warning: open.ply: the mesh is open (4 boundary edges)" in capsys.readouterr().err
    cubes = [
        trimesh.creation.box(bounds=[[at, at, 0], [at + 0.1, at + 0.1, 0.1]]) for at in (0, 0.1)
    ]
    joined = trimesh.util.concatenate(cubes)
    joined.merge_vertices()
    joined.export("edge.ply")
    assert status_of("new", "edge.toml", "--mesh", "edge.ply") == 0
    assert "warning: edge.ply: 1 edges have more than two triangles" in capsys.readouterr().err


def test_what_cannot_be_written_is_refused_in_one_line(tmp_path: Path, ball: Path, monkeypatch):
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path / "there")
    shutil.copy(ball, "ball.ply")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export("flat.ply")
    refused = {
        "takes the scene's name": ["new", "my.toml"],
        "takes": ["new", "--mesh", "ball.ply"],
        "must be named *.toml": ["new", "my.txt", "--mesh", "ball.ply"],
        "no file": ["new", "my.toml", "--mesh", "gone.ply"],
        "encloses no volume": ["new", "my.toml", "--mesh", "flat.ply"],
        "nor below it": ["new", "my.toml", "--mesh", str(ball)],
        "did you mean 'bunny_fall'": ["new", "my.toml", "--from", "bunny_fal"],
    }
    for words, command in refused.items():
        assert words in command_error(*command)
    assert sorted(os.listdir()) == ["ball.ply", "flat.ply"]
    Path("my.toml").write_text("mine")
    assert (
        status_of("new", "my.toml", "--mesh", "ball.ply") == 2
        and Path("my.toml").read_text() == "mine"
    )
    assert status_of("new", "my.toml", "--mesh", "ball.ply", "--overwrite") == 0


def test_a_shipped_scene_is_copied_as_it_is(tmp_path: Path, capsys):
    assert status_of("new", "--list") == 0 and "bunny_fall " in capsys.readouterr().out
    assert status_of("new", tmp_path / "my.toml", "--from", "bunny_fall") == 0
    shipped = (ROOT / "scenes" / "bunny_fall.toml").read_text()
    assert (tmp_path / "my.toml").read_text() == f"#:schema {SCHEMA_FILE}\n{shipped}"


def packed(folder: Path, kind: str) -> set[str]:
    """Return the files of a wheel, an editable wheel or a source archive, built in a folder."""
    tree = folder / "tree"
    shutil.copytree(ROOT, tree, symlinks=True, ignore=lambda folder, names: [
        name for name in names if name.startswith(".") or name in ("out", "tests", "build",
        "__pycache__")
        or name.endswith((".egg-info", ".png"))
    ])  # fmt: skip
    build = f"from setuptools import build_meta; build_meta.build_{kind}('..')"
    done = python("-c", build, cwd=tree)
    assert done.returncode == 0, done.stderr
    if kind != "sdist":
        return set(zipfile.ZipFile(next(folder.glob("*.whl"))).namelist())
    return {
        name.partition("/")[2] for name in tarfile.open(next(folder.glob("*.tar.gz"))).getnames()
    }


@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_what_is_passed_on_holds_scenes_studies_changes_and_citation(kind: str, tmp_path: Path):
    assert (ROOT / "msmpetsc" / "shipped").is_symlink(), "the clone has them once"
    names, scenes = packed(tmp_path, kind), ROOT / "scenes"
    shipped = [path for path in scenes.rglob("*") if path.suffix in (".toml", ".obj", ".md")]
    assert {scenes / "bunny_fall.toml", scenes / "studies" / "hard" / "plate.obj"} < set(shipped)
    assert {f"msmpetsc/shipped/{path.relative_to(scenes)}" for path in shipped} <= names
    assert all(
        any(name.endswith(own) for name in names)
        for own in ("CHANGELOG.md", "CITATION.cff", "LICENSE")
    )


def test_an_editable_installation_is_a_path_that_type_checkers_can_follow(tmp_path: Path):
    names = packed(tmp_path, "editable")
    assert [name for name in names if "/" not in name] == [
        f"__editable__.msmpetsc-{msmpetsc.__version__}.pth"
    ]


def test_commands_that_are_shown_can_be_pasted(tmp_path: Path, capsys):
    """Names with blanks are quoted."""
    scene, mesh = tmp_path / "my scene.toml", tmp_path / "my box.ply"
    trimesh.creation.box([0.1, 0.2, 0.1]).export(mesh)
    assert status_of("new", scene, "--mesh", mesh) == 0
    command = capsys.readouterr().out.splitlines()[-1].removeprefix("to run it: ")
    assert shlex.split(command) == ["msmpetsc", "run", str(scene), "--picture"]
    told = command_error("run", mesh, "-o", tmp_path / "x.h5").partition("no scene: ")[2]
    assert shlex.split(told) == [
        "msmpetsc",
        "new",
        str(mesh.with_suffix(".toml")),
        "--mesh",
        str(mesh),
    ]
    told = command_error("study", scene).partition("no study: ")[2]
    assert shlex.split(told) == ["msmpetsc", "run", str(scene)]
    told = (
        command_error("check", scene).partition("of ")[2].partition(": ")[2].partition(" stores")[0]
    )
    assert shlex.split(told) == ["msmpetsc", "check", "--update", str(scene)]
