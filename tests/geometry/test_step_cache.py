"""Slow preparing steps are computed once, and never wrongly taken from the cache."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from msmpetsc.geometry import step_cache
from msmpetsc.geometry.step_cache import cached
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


def assert_same(a: Surface, b: Surface) -> None:
    assert np.array_equal(a.points, b.points) and np.array_equal(a.triangles, b.triangles)
    assert a.triangles.dtype == b.triangles.dtype and a.points.dtype == b.points.dtype


def test_a_step_is_computed_once_for_the_same_mesh_and_value(folder):
    step = Step()
    assert_same(cached(step, BODY, 3.0), Step()(BODY, 3.0))
    assert_same(cached(step, BODY, 3.0), Step()(BODY, 3.0))
    assert step.calls == 1 and len(list(folder.iterdir())) == 1
    moved = Surface(BODY.points + 1e-15, BODY.triangles)
    for surface, value in ((BODY, 4.0), (moved, 3.0), (Surface(BODY.points, BODY.triangles[::-1]), 3.0)):
        assert_same(cached(step, surface, value), Step()(surface, value))
    assert step.calls == 4


def test_what_is_damaged_is_computed_again(folder):
    step = Step()
    cached(step, BODY)
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    for damage in (b"", whole[:1000], whole[:5000] + b"x" + whole[5001:]):
        path.write_bytes(damage)
        assert_same(cached(step, BODY), Step()(BODY))
    assert step.calls == 4


def test_small_meshes_are_not_kept_and_old_files_go(folder, monkeypatch):
    step, small = Step(), Surface(BODY.points, BODY.triangles[:100])
    cached(step, small)
    cached(step, small)
    assert step.calls == 2 and not folder.exists()
    monkeypatch.setattr(step_cache, "MOST_FILES", 2)
    for value in (1.0, 2.0, 3.0):
        cached(step, BODY, value)
    assert len(list(folder.iterdir())) == 2
