"""Reading, measuring and checking surfaces."""

import gzip
import json
import os
import struct
import tracemalloc
from pathlib import Path

import meshio
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from msmpetsc.errors import InputError
from msmpetsc.geometry.readers import read_surface
from msmpetsc.geometry.surface import Surface, check_encloses, examine, first_of_equal

# name: points, triangles, boundary edges, non-manifold edges (from the notes that come with them)
REAL = {
    "armadillo.ply": (12602, 25200, 0, 0),
    "bunny.ply": (28088, 56172, 0, 0),
    "dragon.ply": (23566, 47140, 0, 0),
    "lung.ply": (23516, 47028, 0, 0),
    "lung_parts.ply": (31997, 63974, 0, 0),
    "heart.ply": (34193, 68410, 0, 0),
    "heart_vessels.ply": (11281, 22562, 0, 0),
    "brain.ply": (77124, 154244, 0, 0),
    "brain_mni.ply": (40708, 81504, 0, 0),
    "nasty_bunny_holes.ply": (35947, 69451, 223, 0),
    "nasty_bunny_nonmanifold.ply": (50000, 99785, 353, 132),
    "nasty_heart_hra.ply": (105497, 208778, 2318, 0),
    "nasty_dragon_welsh_457k.ply": (228687, 457345, 2, 1),
    # its notes count 108 non-manifold edges: the collapsed edges of its 108 degenerate triangles
    "nasty_dragon_stanford_871k.ply.gz": (437645, 871414, 0, 0),
}

SIDES = (1.0, 2.0, 3.0)


def box(sides=SIDES) -> Surface:
    mesh = trimesh.creation.box(sides)
    return Surface(np.array(mesh.vertices), np.array(mesh.faces, np.int64))


def write(path: Path, surface: Surface) -> Path:
    """The surface in the format that the file's name says."""
    kind = path.suffix[1:]
    if kind in ("vtu", "vtk"):
        meshio.Mesh(surface.points, [("triangle", surface.triangles)]).write(path)
    elif kind == "mz3":
        header = struct.pack("<HHIII", 0x5A4D, 3, len(surface.triangles), len(surface.points), 4)
        body = surface.triangles.astype("<i4").tobytes() + surface.points.astype("<f4").tobytes()
        path.write_bytes(gzip.compress(header + b"skip" + body))
    else:
        trimesh.Trimesh(surface.points, surface.triangles, process=False).export(path)
    return path


@pytest.mark.parametrize("name", REAL)
def test_real_meshes_have_the_counts_of_their_notes(name):
    folder = os.environ.get("MSMPETSC_MESH_DIR")
    if not folder:
        pytest.skip("MSMPETSC_MESH_DIR is not set")
    surface = read_surface(Path(folder) / name)
    report = examine(surface)
    v, f, boundary, nonmanifold = REAL[name]
    assert surface.points.shape == (v, 3) and surface.triangles.shape == (f, 3)
    assert surface.points.dtype == np.float64 and surface.triangles.dtype == np.int64
    assert (report.boundary_edges, report.nonmanifold_edges) == (boundary, nonmanifold)
    assert report.closed == (boundary == 0)
    assert report.inconsistent_edges == 0
    assert report.unused_points == (1113 if name == "nasty_bunny_holes.ply" else 0)
    assert report.degenerate_triangles == (108 if "stanford_871k" in name else 0)
    assert (report.volume < 0) == (name == "nasty_bunny_holes.ply")
    assert bool(check_encloses(surface, report)) == (boundary > 0)


@pytest.mark.parametrize("kind", ["ply", "obj", "stl", "off", "glb", "mz3", "vtu", "vtk"])
def test_every_format_gives_the_same_box(tmp_path, kind, capfd):
    surface = read_surface(write(tmp_path / f"box.{kind}", box()))
    report = examine(surface)
    assert len(surface.triangles) == 12
    assert report.closed and report.volume == pytest.approx(6) and report.area == pytest.approx(22)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", ["ply", "obj", "stl"])
def test_compressed_files_are_read(tmp_path, kind):
    plain = write(tmp_path / f"box.{kind}", box())
    packed = tmp_path / f"box.{kind}.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    assert examine(read_surface(packed)).volume == pytest.approx(6)


def test_the_parts_of_a_gltf_are_joined_where_they_stand(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(SIDES))
    shift = trimesh.transformations.translation_matrix([5, 0, 0])
    scene.add_geometry(trimesh.creation.box(SIDES), transform=shift)
    scene.export(tmp_path / "two.glb")
    for name, data in scene.export(file_type="gltf").items():
        (tmp_path / name).write_bytes(data)
    for name in ("two.glb", "model.gltf"):
        surface = read_surface(tmp_path / name)
        assert len(surface.triangles) == 24
        assert examine(surface).volume == pytest.approx(12)
        assert np.ptp(surface.points, axis=0) == pytest.approx([6, 2, 3])


def test_polygons_are_cut_into_triangles(tmp_path):
    """A prism: two triangles, three quads; volume 1/2."""
    points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1)]
    faces = [(0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)]
    text_points = [" ".join(map(str, p)) for p in points]
    header = (
        "ply\nformat {} 1.0\nelement vertex 6\nproperty float x\nproperty float y\n"
        "property float z\nelement face 5\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = [" ".join(map(str, (len(f), *f))) for f in faces]
    obj = [f"v {p}" for p in text_points]
    obj += ["f " + " ".join(str(i + 1) for i in f) for f in faces]
    packed = b"".join(struct.pack(f"<B{len(f)}i", len(f), *f) for f in faces)
    contents = {
        "ascii.ply": (header.format("ascii") + "\n".join(text_points + rows)).encode(),
        "binary.ply": header.format("binary_little_endian").encode() + struct.pack("<18f", *sum(points, ())) + packed,
        "prism.obj": "\n".join(obj).encode(),
        "prism.off": "\n".join(["OFF", "6 5 0", *text_points, *rows]).encode(),
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        report = examine(read_surface(tmp_path / name))
        assert report.closed and report.volume == pytest.approx(0.5), name


@pytest.mark.parametrize("kind", ["vtu", "vtk"])
def test_tetrahedra_give_their_outer_surface(tmp_path, kind):
    """A box filled with tetrahedra around its middle, every other one wound the wrong way."""
    surface = box()
    tetrahedra = np.column_stack([surface.triangles, np.full(12, 8)])
    tetrahedra[::2] = tetrahedra[::2][:, [1, 0, 2, 3]]
    path = tmp_path / f"box.{kind}"
    meshio.Mesh(np.vstack([surface.points, [[0, 0, 0]]]), [("tetra", tetrahedra)]).write(path)
    outer = read_surface(path)
    report = examine(outer)
    assert len(outer.points) == 8 and len(outer.triangles) == 12
    assert report.closed and report.volume == pytest.approx(6) and report.inconsistent_edges == 0


PLY_HEADER = (
    "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\n"
    "property float z\nelement face {}\nproperty list uchar int vertex_indices\nend_header\n"
)
TRIANGLE = "0 0 0\n1 0 0\n0 1 0\n"
BAD = {
    "empty.ply": b"",
    "text.ply": b"Dear all,\nplease find the mesh attached.\n",
    "garbage.stl": bytes(range(256)) * 3,
    "garbage.glb": bytes(range(256)),
    "garbage.vtu": b"<html><body>404</body></html>",
    "garbage.vtk": b"# vtk DataFile Version 9.9\nhello\n",
    "garbage.mz3": b"MZ",
    "garbage.off": b"hello",
    "notgzip.ply.gz": b"\x1f\x8bnot gzip at all",
    "points.ply": PLY_HEADER.format("ascii", 3, 0).encode() + TRIANGLE.encode(),
    "nothing.ply": PLY_HEADER.format("ascii", 0, 0).encode(),
    "words.obj": b"hello\nworld\n",
    "nan.ply": PLY_HEADER.format("ascii", 3, 1).encode() + b"0 0 0\n1 nan 0\n0 1 0\n3 0 1 2\n",
    "inf.obj": b"v 0 0 0\nv 1 inf 0\nv 0 1 0\nf 1 2 3\n",
    "range.ply": PLY_HEADER.format("ascii", 3, 1).encode() + TRIANGLE.encode() + b"3 0 1 7\n",
    "negative.ply": PLY_HEADER.format("ascii", 3, 1).encode() + TRIANGLE.encode() + b"3 0 1 -1\n",
    "range.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
    "rows.ply": PLY_HEADER.format("ascii", 3, 2).encode() + TRIANGLE.encode() + b"3 0 1 2\n",
    "word.ply": PLY_HEADER.format("ascii", 3, 1).encode() + b"0 0 0\n1 x 0\n0 1 0\n3 0 1 2\n",
    "mesh.docx": b"PK",
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line_naming_them(tmp_path, name, capfd):
    path = tmp_path / name
    path.write_bytes(BAD[name])
    with pytest.raises(InputError) as caught:
        read_surface(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_reasons_are_named(tmp_path):
    def reason(name):
        (tmp_path / name).write_bytes(BAD[name])
        with pytest.raises(InputError) as caught:
            read_surface(tmp_path / name)
        return str(caught.value)

    assert "NaN or infinite" in reason("nan.ply") and "NaN or infinite" in reason("inf.obj")
    assert "outside 0..2: 7" in reason("range.ply") and "-1" in reason("negative.ply")
    assert "no triangles" in reason("points.ply") and "no triangles" in reason("words.obj")
    assert "1 of 2 face rows" in reason("rows.ply")
    assert "is empty" in reason("empty.ply") and "not a mesh format" in reason("mesh.docx")


def test_missing_files_and_folders_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_surface(tmp_path / "none.ply")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        read_surface(tmp_path / "folder.ply")


@pytest.mark.parametrize("kind", ["ply", "stl", "off", "glb", "mz3", "vtu", "vtk"])
def test_truncated_files_are_refused(tmp_path, kind):
    path = write(tmp_path / f"box.{kind}", box())
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 3 // 4])
    with pytest.raises(InputError):
        read_surface(path)


def test_a_small_file_that_claims_much_allocates_little(tmp_path):
    rows = 10**9
    accessor = {"componentType": 5126, "type": "VEC3", "count": rows}
    index = {"componentType": 5125, "type": "SCALAR", "count": 3}
    gltf = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [accessor, index],
    }
    hollow = {
        "ascii.ply": PLY_HEADER.format("ascii", rows, rows),
        "binary.ply": PLY_HEADER.format("binary_little_endian", rows, rows),
        "big.vtk": f"# vtk DataFile Version 3.0\nx\nBINARY\nDATASET UNSTRUCTURED_GRID\nPOINTS {rows} double\n",
        "big.off": f"OFF\n{rows} {rows} 0\n",
        "big.gltf": json.dumps(gltf),
    }
    for name, content in hollow.items():
        (tmp_path / name).write_text(content)
        tracemalloc.start()
        with pytest.raises(InputError):
            read_surface(tmp_path / name)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 1e8, name


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kind=st.sampled_from(["ply", "obj", "stl", "off", "glb", "mz3", "vtu", "vtk"]),
    damage=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=8),
)
def test_a_damaged_file_gives_a_mesh_or_an_input_error(tmp_path, kind, damage):
    path = write(tmp_path / f"box.{kind}", box())
    content = bytearray(path.read_bytes())
    for place, byte in damage:
        content[int(place * (len(content) - 1))] = byte
    path.write_bytes(content)
    try:
        surface = read_surface(path)
    except InputError:
        return
    assert np.isfinite(surface.points).all()
    assert 0 <= surface.triangles.min() <= surface.triangles.max() < len(surface.points)


def test_edges_of_an_open_flipped_and_finned_box():
    surface = box()
    clean = examine(surface)
    assert clean.closed and clean.volume == pytest.approx(6) and clean.area == pytest.approx(22)
    assert (clean.boundary_edges, clean.nonmanifold_edges, clean.inconsistent_edges) == (0, 0, 0)

    holed = examine(Surface(surface.points, surface.triangles[1:]))
    assert holed.boundary_edges == 3 and not holed.closed

    triangles = surface.triangles.copy()
    triangles[0] = triangles[0, ::-1]
    assert examine(Surface(surface.points, triangles)).inconsistent_edges == 3

    points = np.vstack([surface.points, [[9, 9, 9], [8, 8, 8]]])
    a, b, _ = surface.triangles[0]
    fin = examine(Surface(points, np.vstack([surface.triangles, [[a, b, 8]]])))
    assert (fin.nonmanifold_edges, fin.boundary_edges, fin.unused_points) == (1, 2, 1)


def test_loose_triangles_count_as_closed():
    surface = box()
    loose = Surface(surface.points[surface.triangles].reshape(-1, 3), np.arange(36).reshape(-1, 3))
    assert examine(loose).closed
    # a triangle with two corners at one place bounds nothing
    degenerate = Surface(loose.points, np.vstack([loose.triangles, [[0, 1, 0]]]))
    assert examine(degenerate).closed and examine(degenerate).degenerate_triangles == 1


@given(
    shift=arrays(float, 3, elements=st.floats(-100, 100)),
    seed=st.integers(0, 1000),
    sides=st.tuples(*[st.floats(0.01, 10)] * 3),
)
def test_volume_does_not_depend_on_place_or_numbering(shift, seed, sides):
    rng = np.random.default_rng(seed)
    surface = box(sides)
    order = rng.permutation(8)
    moved = Surface((surface.points + shift)[order], np.argsort(order)[surface.triangles][rng.permutation(12)])
    assert examine(moved).volume == pytest.approx(np.prod(sides), rel=1e-6)
    inwards = Surface(moved.points, moved.triangles[:, ::-1])
    assert examine(inwards).volume == pytest.approx(-np.prod(sides), rel=1e-6)


@given(arrays(np.int64, (12, 3), elements=st.integers(-1, 1)))
def test_equal_points_share_the_number_of_the_first(points):
    points = points.astype(float)
    points[0] *= -1.0  # may give -0.0, which equals 0.0
    expected = [next(j for j in range(12) if (points[j] == points[i]).all()) for i in range(12)]
    assert first_of_equal(points).tolist() == expected


def rotated(surface: Surface) -> Surface:
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3]
    return Surface(surface.points @ turn.T, surface.triangles)


def test_a_thin_plate_and_a_thin_rod_enclose_a_volume():
    for sides in ((1, 1, 1e-3), (1, 1e-3, 1e-3), (1e3, 1e3, 1), (1e-6, 1e-6, 1e-9)):
        surface = rotated(box(sides))
        assert check_encloses(surface, examine(surface)) == []


def test_what_encloses_nothing_is_refused():
    sheet = Surface(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    solid = box()
    against = Surface(
        np.vstack([solid.points, solid.points + 5.0]),
        np.vstack([solid.triangles, solid.triangles[:, ::-1] + 8]),
    )
    for surface in (sheet, rotated(sheet), box((1, 1, 0)), rotated(box((1, 1, 0))), against):
        with pytest.raises(InputError, match="encloses no volume"):
            check_encloses(surface, examine(surface))
    # a sheet folded over its own back and bent: closed, not flat, no volume
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    fold = Surface(corner, np.array([[0, 1, 2], [0, 2, 1], [0, 2, 3], [0, 3, 2]]))
    with pytest.raises(InputError, match="folded"):
        check_encloses(fold, examine(fold))


def test_doubts_are_named():
    surface = box()

    def doubts(triangles):
        changed = Surface(surface.points, triangles)
        return " / ".join(check_encloses(changed, examine(changed)))

    holed = doubts(surface.triangles[1:])
    assert "3 boundary edges" in holed and "winding number" in holed and "inwards" not in holed
    assert "inwards (volume -6" in doubts(surface.triangles[:, ::-1])
    flipped = surface.triangles.copy()
    flipped[0] = flipped[0, ::-1]
    assert "3 edges have triangles wound against" in doubts(flipped)
    doubled = np.vstack([surface.triangles, surface.triangles[:1]])
    assert "more than two triangles" in doubts(doubled)
