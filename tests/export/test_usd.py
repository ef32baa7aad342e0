"""USD's own library reads USD files back: all frames in time, and a mesh for each body."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import small_result
from small_result import DT, FRAMES, POINTS
from test_export import FAR, far_frames, surface

from msmpetsc.export.formats import export

pytest.importorskip("pxr", reason="usd-core is not installed: the extra usd")
from pxr import Usd, UsdGeom

from msmpetsc.export.usd import frames_a_second, up_axis

TRIANGLES = np.array([[0, 1, 2], [1, 2, 3]])


def opened(path: Path) -> tuple[Usd.Stage, list[UsdGeom.Mesh]]:
    """Return the stage and its meshes, which live as long as the stage."""
    stage = Usd.Stage.Open(str(path))
    return stage, [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]


def points_of(mesh: UsdGeom.Mesh, code: float) -> np.ndarray:
    """Return the points (v, 3) in the coordinates of the stage."""
    x, y, z = UsdGeom.XformCache(code).GetLocalToWorldTransform(mesh.GetPrim()).ExtractTranslation()
    return np.array(mesh.GetPointsAttr().Get(code)) + np.array([x, y, z])


@pytest.mark.parametrize("ending", [".usd", ".usda", ".usdc"])
def test_points_are_those_of_the_result_at_every_time(
    bar_result: Path, tmp_path: Path, ending: str
):
    path = export(bar_result, tmp_path / f"y{ending}")
    assert path.read_bytes().startswith(b"#usda" if ending == ".usda" else b"PXR-USDC")
    stage, (mesh,) = opened(path)
    rate = stage.GetTimeCodesPerSecond()
    assert rate == pytest.approx(1 / DT)
    assert stage.GetEndTimeCode() - stage.GetStartTimeCode() == FRAMES - 1
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1 and UsdGeom.GetStageUpAxis(stage) == "Z"
    assert stage.GetDefaultPrim().GetPath() == mesh.GetPath().GetParentPath()
    assert mesh.GetPointsAttr().GetTimeSamples() == list(range(FRAMES))
    # positions are linear between frames
    for index in (0, 1, 2.5, 4):
        code = Usd.TimeCode(index * DT * rate)
        points = np.array(mesh.GetPointsAttr().Get(code))
        extent = np.array([points.min(axis=0), points.max(axis=0)])
        assert points_of(mesh, code) == pytest.approx(surface(index), abs=1e-6)
        assert np.array(mesh.GetExtentAttr().Get(code)) == pytest.approx(extent, abs=1e-6)
    lengths = np.linalg.norm(np.array(mesh.GetNormalsAttr().Get(0)), axis=1)
    assert lengths == pytest.approx(1, abs=1e-6)


def test_saves_do_not_fill_a_binary_file_of_many_frames(tmp_path: Path):
    frames = [small_result.frame(k, surface=surface(0)) for k in range(1000)]
    result = small_result.write(tmp_path / "x.h5", frames)
    path = export(result, tmp_path / "y.usdc")
    # 16 MB if it is saved at each frame
    assert path.stat().st_size < 1e6


def test_points_far_from_the_origin_are_exact(tmp_path: Path):
    result = small_result.write(tmp_path / "x.h5", far_frames())
    _stage, (mesh,) = opened(export(result, tmp_path / "y.usdc"))
    for index in (0, 3):
        assert points_of(mesh, index) == pytest.approx(surface(index) + FAR, rel=0, abs=1e-7)


def test_the_mesh_is_what_usd_asks_for(bar_result: Path, tmp_path: Path):
    _stage, (mesh,) = opened(export(bar_result, tmp_path / "y.usdc"))
    counts, corners = mesh.GetFaceVertexCountsAttr().Get(), mesh.GetFaceVertexIndicesAttr().Get()
    assert list(counts) == [3, 3] and list(corners) == TRIANGLES.ravel().tolist()
    assert UsdGeom.Mesh.ValidateTopology(corners, counts, len(POINTS)) == (True, "")
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
    assert len(mesh.GetDisplayColorAttr().Get()) == 1
    assert mesh.GetNormalsInterpolation() == "vertex"


def test_several_bodies_are_a_mesh_each(tmp_path: Path):
    """Two bodies, the small result twice, are a mesh each; the second moves the other way."""
    result = small_result.write(tmp_path / "x.h5")
    with h5py.File(result, "r+") as file:
        moved = file["frames/surface"][:]
        for name in ("surface/points", "surface/triangles", "frames/surface"):
            del file[name]
        file["surface/points"] = np.concatenate([POINTS, POINTS + 5])
        file["surface/triangles"] = np.concatenate([TRIANGLES, TRIANGLES[:1] + 4])
        file["surface/body"] = np.repeat([0, 1], 4).astype("i4")
        file["frames/surface"] = np.concatenate([moved, 5 + 2 * POINTS - moved], axis=1)
    _stage, (first, second) = opened(export(result, tmp_path / "y.usda"))
    assert (first.GetPrim().GetName(), second.GetPrim().GetName()) == ("body_0", "body_1")
    assert points_of(first, 3) == pytest.approx(surface(3), abs=1e-6)
    assert points_of(second, 3) == pytest.approx(5 + surface(-3), abs=1e-6)
    # indices count the body's own points
    assert list(second.GetFaceVertexIndicesAttr().Get()) == [0, 1, 2]


def test_chosen_frames_keep_their_times(bar_result: Path, tmp_path: Path):
    stage, (mesh,) = opened(export(bar_result, tmp_path / "y.usda", frames=[1, 3, 4]))
    rate = stage.GetTimeCodesPerSecond()
    times = np.array(mesh.GetPointsAttr().GetTimeSamples()) / rate
    assert times == pytest.approx([0.01, 0.03, 0.04])
    assert points_of(mesh, 0.03 * rate) == pytest.approx(surface(3), abs=1e-6)
    # a single frame
    assert frames_a_second(np.array([0.5])) == 1


@pytest.mark.parametrize(
    ("gravity", "axis"),
    [((0, 0, -9.81), "Z"), ((0, -9.81, 0), "Y"), ((-9.81, 0, 0), "Z"), ((0, 0, 0), "Z")],
)
def test_upward_is_against_gravity(gravity: tuple[float, ...], axis: str):
    assert up_axis({"gravity": {"acceleration": list(gravity)}}) == axis
    assert up_axis({}) == "Z"


def test_a_name_that_usd_would_not_take(tmp_path: Path):
    result = small_result.write(tmp_path / "2 bars-é.h5")
    stage, found = opened(export(result, tmp_path / "2 bars-é.usda"))
    assert stage.GetDefaultPrim().IsValid() and len(found) == 1
