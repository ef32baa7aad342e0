"""``msmpetsc new`` measures a mesh and writes a scene that runs at once."""

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

import msmpetsc
from msmpetsc.scene.key_table import SCHEMA_FILE, json_schema
from msmpetsc.scene.reading import load_scene


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


BODIES = {
    "ball": (trimesh.creation.icosphere(subdivisions=2, radius=0.1), "to be in m,", 0.2),
    "mm": (trimesh.creation.icosphere(subdivisions=2, radius=40), "to be in mm,", 0.08),
    "bar": (trimesh.creation.box([0.1, 0.5, 0.1]), "to be in m,", 0.1),
    "inwards": (trimesh.creation.box([0.1, 0.1, 0.1]), '"orient"', 0.1),
}


@pytest.mark.parametrize("name", BODIES)
def test_a_first_scene_runs_at_once(name: str, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    mesh, words, height = BODIES[name]
    if name == "inwards":
        mesh.invert()
    mesh.export(f"{name}.stl")
    assert status_of("new", "my.toml", "--mesh", f"{name}.stl") == 0
    told = capsys.readouterr()
    assert "msmpetsc run my.toml" in told.out
    text = Path("my.toml").read_text()
    assert text.startswith(f"#:schema {SCHEMA_FILE}\n") and words in text + told.err
    assert json.loads(Path(SCHEMA_FILE).read_text()) == json.loads(json.dumps(json_schema()))
    assert status_of("run", "my.toml", "-o", "my.h5", "--set", "cages.count=150", "--quiet") == 0
    with msmpetsc.open("my.h5") as run:
        moved = np.linalg.norm(run.frames.position[-1] - run.lattice.nodes[:], axis=1).max()
        assert 0.1 * height < moved < height, "it falls on the ground"


def test_what_is_found_of_a_mesh_is_said(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    box = trimesh.creation.box([0.1, 0.1, 0.1])
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
    assert status_of("new", "my.toml", "--mesh", "ball.ply") == 2
    assert Path("my.toml").read_text() == "mine"
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
    """Printed commands quote names with blanks."""
    scene, mesh = tmp_path / "my scene.toml", tmp_path / "my box.ply"
    trimesh.creation.box([0.1, 0.2, 0.1]).export(mesh)
    assert status_of("new", scene, "--mesh", mesh) == 0
    command = capsys.readouterr().out.splitlines()[-1].removeprefix("to run it: ")
    assert shlex.split(command) == ["msmpetsc", "run", str(scene), "--picture"]
    told = (
        command_error("check", scene).partition("of ")[2].partition(": ")[2].partition(" stores")[0]
    )
    assert shlex.split(told) == ["msmpetsc", "check", "--update", str(scene)]
