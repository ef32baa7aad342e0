"""Wrong or hostile scene files, study files and --set values are refused, also under mpiexec."""

from pathlib import Path

import pytest
from bad_input import TRIALS, damage, damaged, refusal
from block_scene import block_scene
from conftest import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st

from msmpetsc.errors import InputError
from msmpetsc.scene.reading import load_scene
from msmpetsc.study.cases import study_cases
from msmpetsc.study.study_file import load_study

SCENES = [path.read_bytes() for path in sorted((ROOT / "scenes").rglob("*.toml"))]
ONCE = {"step": 0.01, "duration": 0.02}


@settings(TRIALS, max_examples=60)
@given(content=st.sampled_from(SCENES), changes=damage, study=st.booleans())
def test_a_damaged_scene_or_study_is_read_or_refused(tmp_path, content, changes, study):
    (tmp_path / "x.toml").write_bytes(damaged(content, changes))
    refusal(lambda: (load_study if study else load_scene)(tmp_path / "x.toml"), lines=True)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a scene, beside files that the scene must not reach."""
    (tmp_path / "own" / "below").mkdir(parents=True)
    block_scene(tmp_path / "own", time=ONCE)
    for name in ("out.ply", "own/below/in.ply"):
        (tmp_path / name).write_bytes((tmp_path / "own" / "scene.ply").read_bytes())
    (tmp_path / "own" / "link.ply").symlink_to("../out.ply")
    (tmp_path / "own" / "loop.ply").symlink_to("loop.ply")
    return tmp_path / "own"


def naming(folder: Path, name: str) -> Path:
    path = folder / "scene.toml"
    path.write_text(path.read_text().replace("scene.ply", name))
    return path


@pytest.mark.parametrize(
    "name",
    [
        "../out.ply",
        "link.ply",
        "loop.ply",
        "loop.ply/in.ply",
        "below/../../out.ply",
        "/etc/hostname",
    ],
)
def test_a_scene_names_no_file_outside_its_folder(folder, name):
    path = naming(folder, name)
    said = refusal(lambda: load_scene(path))
    assert "mesh.source" in said and "--set mesh.source=PATH allows it" in said
    # the user's own name remains
    assert load_scene(path, [f"mesh.source={name}"]).mesh.source == name
    assert refusal(lambda: load_scene(path, [f"mesh.source={name}"], by_user=False))
    load_scene(path, ["mesh.source=below/in.ply"], by_user=False)


def test_painted_points_come_from_the_folder_too(folder):
    path = folder / "scene.toml"
    path.write_text(path.read_text() + '\n[[pin]]\nregion = { painted = "../numbers.txt" }\n')
    assert "pin.0.region.painted" in refusal(lambda: load_scene(path))
    load_scene(path, ["pin.0.region.painted=../numbers.txt"])


STUDY = '[[scene]]\nname = "a"\nfile = "scene.toml"\nset = ["{}"]\n[[sweep]]\noptions = ["{}"]\n'


@pytest.mark.parametrize(
    "options",
    [
        "-pc_type python -pc_python_type evil.Solver", "-ksp_type python", "-dll_append evil.so",
        "-options_file x",
        "-ksp_view :stolen.txt", "-log_view :x", "-o important.h5", "--overwrite", "-ksp_monitor",
        "-debug_terminal xterm",
        "-ksp_rtol ../x", "-on_error_attach_debugger", "-mat_view binary", "evil.py",
    ],
)  # fmt: skip
def test_a_study_chooses_solvers_and_no_more(folder, options):
    (folder / "study.toml").write_text(STUDY.format("time.step=0.01", options))
    if options == "evil.py":
        # the value belongs to no option, so PETSc would not load it
        load_study(folder / "study.toml")
    else:
        assert "only solver options" in refusal(lambda: load_study(folder / "study.toml"))


def test_a_study_names_no_mesh_outside(folder):
    (folder / "study.toml").write_text(
        STUDY.format("mesh.source=../out.ply", "-pc_type jacobi -ksp_rtol 1e-2")
    )
    with pytest.raises(InputError, match=r"mesh\.source"):
        study_cases(load_study(folder / "study.toml"), folder, False)


def test_the_own_scenes_and_studies_name_what_they_may():
    for path in (ROOT / "scenes").rglob("*.toml"):
        # this file is the table of scripts/yardstick.py
        if path.name == "cases.toml":
            continue
        # a study has no materials
        if "[material]" in path.read_text():
            load_scene(path)
        else:
            load_study(path)
