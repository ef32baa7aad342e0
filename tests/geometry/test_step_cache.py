"""Slow preparing steps are computed once, and never wrongly taken from the cache."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from msmpetsc.geometry import prepare
from msmpetsc.geometry.prepare import cached
from msmpetsc.geometry.surface import Surface

BALL = trimesh.creation.icosphere(subdivisions=5)  # 20,480 triangles
BODY = Surface(np.array(BALL.vertices), np.array(BALL.faces, np.int64))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "msmpetsc" / "prepared"


class Step:
    """A step that counts how often it is computed."""

    __name__ = "stretch"

    def __init__(self):
        self.calls = 0

    def __call__(self, surface: Surface, factor: float = 2.0) -> Surface:
        self.calls += 1
        return Surface(surface.points * factor, surface.triangles)


def test_a_step_is_computed_once_for_the_same_mesh_and_value_and_again_where_its_file_is_damaged(folder):
    step = Step()
    first, again = cached(step, BODY, 3.0), cached(step, BODY, 3.0)
    assert step.calls == 1 and np.array_equal(first.points, again.points) and again.triangles.dtype == np.int64
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    for damage in (b"", whole[:1000], whole[:5000] + b"x" + whole[5001:]):
        path.write_bytes(damage)
        assert np.array_equal(cached(step, BODY, 3.0).points, 3.0 * BODY.points)
    moved = Surface(BODY.points + 1e-15, BODY.triangles)
    for surface, value in ((BODY, 4.0), (moved, 3.0), (Surface(BODY.points, BODY.triangles[::-1]), 3.0)):
        assert np.array_equal(cached(step, surface, value).points, value * surface.points)
    assert step.calls == 7


def test_small_meshes_are_not_kept_and_old_files_go(folder, monkeypatch):
    step, small = Step(), Surface(BODY.points, BODY.triangles[:100])
    cached(step, small)
    assert step.calls == 1 and not folder.exists()
    monkeypatch.setattr(prepare, "MOST_FILES", 2)
    for value in (1.0, 2.0, 3.0):
        cached(step, BODY, value)
    assert len(list(folder.iterdir())) == 2
