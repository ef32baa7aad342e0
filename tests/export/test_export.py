"""Independent libraries read exported files back and find the frames of the result."""

import json
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import h5py
import meshio
import numpy as np
import pytest
import pyvista
import small_result
import trimesh
import vtk
from one_process import input_error, status_of
from small_result import DT, FRAMES, NODES, POINTS, H, X, position
from vtk.util.numpy_support import vtk_to_numpy

import msmpetsc
from msmpetsc.errors import InputError
from msmpetsc.export.formats import export, normals, write_glb
from msmpetsc.fields import Frame
from msmpetsc.results.xdmf import write_xdmf

PINNED = [0, 3]
SCALARS = ("von_mises", "pressure", "strain_energy")


def surface(index: float) -> np.ndarray:
    return POINTS + 0.01 * index * small_result.X


def y_up(points: np.ndarray) -> np.ndarray:
    """Return points in the axes of glTF."""
    return points[:, [0, 2, 1]] * [1, 1, -1]


# [m], a place in UTM coordinates
FAR = np.array([441871.6, 6329700.7, 120.3])


def far_frames() -> list[Frame]:
    return [small_result.frame(k, surface=surface(k) + FAR) for k in range(FRAMES)]


def complaints(reader: vtk.vtkAlgorithm) -> list[str]:
    """Return a list that collects every error and warning of a VTK reader."""
    heard: list[str] = []

    def hear(_, event: str, text: str) -> None:
        heard.append(f"{event}: {text}")

    hear.CallDataType = vtk.VTK_STRING  # type: ignore[attr-defined]
    for event in (vtk.vtkCommand.ErrorEvent, vtk.vtkCommand.WarningEvent):
        reader.AddObserver(event, hear)
    return heard


def test_gltf_moves_in_vtk_and_stands_in_trimesh(bar_result: Path, tmp_path: Path):
    path = export(bar_result, tmp_path / "x.glb")
    # the node of the scene turns z up to y up
    (mesh,) = trimesh.load(path).dump()
    both = (mesh.vertices, y_up(surface(0)))
    assert np.array_equal(*(np.unique(points.round(5), axis=0) for points in both))
    reader = vtk.vtkGLTFReader()
    reader.SetFileName(str(path))
    heard = complaints(reader)
    reader.ApplyDeformationsToGeometryOn()
    reader.SetFrameRate(round(2 / DT))
    reader.UpdateInformation()
    assert reader.GetNumberOfAnimations() == 1
    assert reader.GetAnimationDuration(0) == pytest.approx(DT * (FRAMES - 1))
    reader.EnableAnimation(0)
    reader.UpdateInformation()
    # positions are linear between frames
    for index in (0, 1, 3, 2.5):
        reader.UpdateTimeStep(DT * index)
        (block,) = pyvista.wrap(reader.GetOutput()).recursive_iterator()
        assert np.allclose(block.points, y_up(surface(index)), atol=1e-6), index
    assert heard == []


def test_gltf_keeps_to_its_rules(bar_result: Path, tmp_path: Path):
    data = export(bar_result, tmp_path / "x.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    assert int.from_bytes(data[8:12], "little") == len(data) and length % 4 == 0
    assert document["buffers"][0]["byteLength"] == len(data) - 28 - length
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        kind = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        start = 28 + length + view["byteOffset"]
        values = np.frombuffer(data, kind, view["byteLength"] // 4, start)
        rows = values.reshape(accessor["count"], -1)
        assert np.array_equal(rows.min(axis=0), np.array(accessor["min"], kind))
        assert np.array_equal(rows.max(axis=0), np.array(accessor["max"], kind))
    data = export(bar_result, tmp_path / "one.glb", frames=[2]).read_bytes()
    one = json.loads(data[20:].split(b"BIN\0")[0][:-4])
    assert "animations" not in one and "targets" not in one["meshes"][0]["primitives"][0]


def test_more_frames_than_a_gltf_can_hold_are_refused_at_once(tmp_path: Path):
    count = 40_000
    run = SimpleNamespace(path=tmp_path / "x.h5", frames=SimpleNamespace(time=np.arange(count)))
    run.indices, run.surface_at = lambda _: np.array([[0, 1, 2]]), lambda _: POINTS
    path = tmp_path / "x.glb"
    assert "4 GiB" in input_error(lambda: write_glb(run, range(count), path))
    assert not path.exists()


def test_normals_are_those_of_a_ball():
    ball = trimesh.creation.icosphere(subdivisions=2)
    assert np.allclose(normals(ball.vertices, ball.faces), ball.vertices, atol=0.03)
    alone = normals(np.zeros((4, 3)), np.array([[0, 1, 2]]))
    # normals of a collapsed body may have any direction, but have length 1
    assert np.allclose(np.linalg.norm(alone, axis=1), 1)


@pytest.mark.parametrize("ending", [".obj", ".ply", ".stl"])
def test_one_frame_of_the_surface(bar_result: Path, tmp_path: Path, ending: str, capfd):
    mesh = trimesh.load(export(bar_result, tmp_path / f"x{ending}"), process=False)
    assert capfd.readouterr() == ("", "")
    assert np.allclose(mesh.triangles, surface(FRAMES - 1)[[[0, 1, 2], [1, 2, 3]]], atol=1e-6)


@pytest.mark.parametrize("ending", [".glb", ".obj", ".ply", ".stl"])
def test_a_surface_far_from_the_origin_is_exact(tmp_path: Path, ending: str):
    result = small_result.write(tmp_path / "x.h5", far_frames())
    with msmpetsc.open(result) as run:
        assert np.array_equal(run.frames.surface[2], surface(2) + FAR)
    path, expected = export(result, tmp_path / f"y{ending}", frames=[2]), surface(2) + FAR
    if ending == ".glb":
        (mesh,) = trimesh.load(path).dump()
        found, expected = mesh.vertices, y_up(expected)
    else:
        mesh = meshio.read(path)
        found = mesh.points[np.unique(mesh.cells_dict["triangle"], return_index=True)[0]]
    gaps = np.linalg.norm(found[:, None] - expected, axis=2)
    assert gaps.min(axis=0).max() < 1e-7 and gaps.min(axis=1).max() < 1e-7


def test_a_surface_that_was_not_stored_comes_from_the_embedding(tmp_path: Path):
    result = small_result.write(tmp_path / "x.h5")
    with h5py.File(result, "r+") as file:
        del file["frames/surface"]
    mesh = meshio.read(export(result, tmp_path / "x.ply", frames=[3]))
    # a point has the weight 1/8 of each corner of its cell
    rows = small_result.cells()[[0, 1, 1, 0]]
    assert np.allclose(mesh.points, position(3)[rows].mean(axis=1))


WRONG = {
    # HDF5 crashed here on a full disk
    "unknown format: name the file *.glb, *.usd": ("x.vtkhdf", {}),
    "has frames 0 to 4, not 5": ("x.glb", {"frames": [0, 5]}),
    "a *.obj holds one frame, not 2": ("x.obj", {"frames": [0, 1]}),
    "must follow each other in time": ("x.glb", {"frames": [3, 1]}),
}


@pytest.mark.parametrize("words", WRONG)
def test_what_cannot_be_exported_is_said_in_one_line(bar_result: Path, tmp_path: Path, words: str):
    name, options = WRONG[words]
    assert words in input_error(lambda: export(bar_result, tmp_path / name, **options))
    assert not list(tmp_path.iterdir())


def test_a_result_without_a_surface(tmp_path: Path):
    result = small_result.write(tmp_path / "x.h5", surface=False)
    with pytest.raises(InputError, match=r"has no surface: it was run with output.surface = false"):
        export(result, tmp_path / "x.obj")


def test_slices_choose_frames_as_for_render(bar_result: Path, tmp_path: Path, capsys):
    whole = export(bar_result, tmp_path / "whole.glb", frames=[0, 2, 4]).read_bytes()
    path = tmp_path / "new" / "x.glb"
    for frames in ("0:5:2", "0,2,-1"):
        assert status_of("export", bar_result, "-o", path, "--frames", frames) == 0
        assert capsys.readouterr().out == f"{path}\n" and path.read_bytes() == whole


def test_the_xdmf_file_is_read_by_vtk_without_a_complaint(tmp_path: Path):
    reader = vtk.vtkXdmfReader()
    reader.SetFileName(str(write_xdmf(small_result.write(tmp_path / "x.h5"))))
    heard = complaints(reader)
    for index in (0, 3, 1):
        reader.UpdateTimeStep(DT * index)
        blocks = pyvista.wrap(reader.GetOutputDataObject(0))
        body, skin = blocks["lattice"], blocks["surface"]
        assert np.allclose(body.points, position(index), atol=1e-6)
        assert np.allclose(skin.points, surface(index), atol=1e-6)
        assert np.allclose(body["displacement"], position(index) - NODES)
        assert np.allclose(skin["displacement"], surface(index) - POINTS, atol=1e-6)
        assert np.allclose(body["velocity"], 0.1 / DT * NODES[:, [2]] * X, atol=1e-4)
        assert np.allclose(skin["velocity"], 0.01 / DT * X, atol=1e-4)
        assert body.n_cells == 2 and body["cell_kind"].tolist() == [1, 1]
        assert body.volume == pytest.approx(2 * H**3)
    assert heard == []


def test_xdmf_is_exact_far_from_the_origin(tmp_path: Path):
    reader = vtk.vtkXdmfReader()
    reader.SetFileName(str(write_xdmf(small_result.write(tmp_path / "x.h5", far_frames()))))
    reader.UpdateTimeStep(DT * 2)
    points = vtk_to_numpy(reader.GetOutputDataObject(0).GetBlock(0).GetPoints().GetData())
    assert np.array_equal(points, surface(2) + FAR)


def stressed(index: int) -> dict[str, np.ndarray]:
    """Return the stress of the bar's nodes and cells at a frame."""
    values: dict[str, np.ndarray] = {}
    for whose, rows in (("", len(NODES)), ("cell_", 2)):
        values |= {f"{whose}{name}": index + np.arange(rows) for name in SCALARS}
        values[f"{whose}stress"] = index + np.arange(6.0 * rows).reshape(-1, 6)
    return values


def test_xdmf_of_many_frames_takes_little_memory(tmp_path: Path):
    path = small_result.write(tmp_path / "x.h5", [small_result.frame(n) for n in range(300)])
    write_xdmf(path)
    tracemalloc.start()
    size = write_xdmf(path).stat().st_size
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < size / 2


def test_stress_comes_with_xdmf(tmp_path: Path):
    """XDMF stores a tensor as two vectors."""
    frames = [small_result.frame(k, **stressed(k)) for k in range(3)]
    result = small_result.write(tmp_path / "x.h5", frames)
    reader = vtk.vtkXdmfReader()
    reader.SetFileName(str(write_xdmf(result)))
    heard = complaints(reader)
    for index in (0, 2, 1):
        reader.UpdateTimeStep(DT * index)
        body, expected = pyvista.wrap(reader.GetOutputDataObject(0).GetBlock(1)), stressed(index)
        for whose, data in (("", body.point_data), ("cell_", body.cell_data)):
            parts = [data[f"{whose}stress_{part}"] for part in ("normal", "shear")]
            assert np.array_equal(np.hstack(parts), expected[f"{whose}stress"])
            for name in SCALARS:
                assert np.array_equal(data[whose + name], expected[whose + name])
    assert heard == []
