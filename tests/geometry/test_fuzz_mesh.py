"""Mesh files of all formats, whole, damaged or hostile, give finite points or a line of error."""

import base64
import json
import struct
import sys
import tempfile
from pathlib import Path

import meshio
import numpy as np
import pytest
import trimesh
from bad_input import TRIALS, damage, damaged, refusal
from hypothesis import given, settings
from hypothesis import strategies as st
from mpi4py import MPI

from msmpetsc.build import read_bodies
from msmpetsc.errors import InputError
from msmpetsc.geometry.prepare import repair
from msmpetsc.geometry.readers import read_surface
from msmpetsc.geometry.surface import Surface, examine
from msmpetsc.scene.reading import load_scene

BOX = trimesh.creation.box(extents=[1, 2, 3])
TETRAHEDRA = [[0, *edge, 7] for edge in [(4, 6), (6, 2), (2, 3), (3, 1), (1, 5), (5, 4)]]
QUADS = b"""mtllib paint.mtl
v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1
f 1 4 3 2\nf 5 6 7 8\nf 1/1 2/1 6/1 5/1\nf 2//1 3//1 7//1 6//1\nf 3 4 8 7\nf -8 -4 -1 -5\n"""
SCENE = """
mesh.source = "{}"
cages.count = 50
material = {{ density = 1e3, young_modulus = 1e5, law = "linear" }}
time = {{ step = 0.01, duration = 0.1 }}
"""


def exported(**options) -> bytes:
    content = BOX.export(**options)
    return content.encode() if isinstance(content, str) else content


def by_meshio(kind: str, cells: str = "triangle", **options) -> bytes:
    """Return the bytes of a mesh of triangles or tetrahedra in a file that meshio writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"x.{kind}")
        corners = BOX.faces if cells == "triangle" else TETRAHEDRA
        meshio.Mesh(BOX.vertices, [(cells, corners)]).write(path, **options)
        return path.read_bytes()


def mz3() -> bytes:
    header = struct.pack("<HHIII", 0x5A4D, 3, len(BOX.faces), len(BOX.vertices), 0)
    return header + BOX.faces.astype("<i4").tobytes() + BOX.vertices.astype("<f4").tobytes()


IN_GLTF = BOX.vertices.astype("<f4").tobytes() + BOX.faces.astype("<u4").tobytes()


def gltf(
    uri: str = "data:application/octet-stream;base64," + base64.b64encode(IN_GLTF).decode(),
) -> bytes:
    """Return a glTF file with its buffers as text in it, or in another file."""
    tree = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1]}, {"mesh": 0, "scale": [1, 2, 1]}],
        "buffers": [{"uri": uri, "byteLength": len(IN_GLTF)}],
        "bufferViews": [
            {"buffer": 0, "byteLength": 96},
            {"buffer": 0, "byteOffset": 96, "byteLength": 144, "byteStride": 4},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 8},
            {"bufferView": 1, "componentType": 5125, "type": "SCALAR", "count": 36},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 4}]}],
    }  # fmt: skip
    return json.dumps(tree).encode()


SEEDS = [
    ("obj", exported(file_type="obj")),
    ("obj", QUADS),
    ("ply", exported(file_type="ply", encoding="ascii")),
    ("ply", exported(file_type="ply")),
    ("stl", exported(file_type="stl")),
    ("stl", exported(file_type="stl_ascii")),
    ("off", exported(file_type="off")),
    ("glb", exported(file_type="glb")),
    ("gltf", gltf()),
    ("mz3", mz3()),
    ("vtk", by_meshio("vtk", binary=False)),
    ("vtk", by_meshio("vtk")),
    ("vtu", by_meshio("vtu", binary=False)),
    ("vtu", by_meshio("vtu", compression=None)),
    ("vtu", by_meshio("vtu", compression="zlib")),
    ("vtu", by_meshio("vtu", compression="lzma")),
    ("msh", by_meshio("msh", file_format="gmsh", binary=False)),
    ("msh", by_meshio("msh", file_format="gmsh")),
    ("msh", by_meshio("msh", file_format="gmsh22", binary=False)),
    ("msh", by_meshio("msh", file_format="gmsh22")),
    ("inp", by_meshio("inp")),
    ("bdf", by_meshio("bdf")),
    *((kind, by_meshio(kind, "tetra")) for kind in ("vtk", "vtu", "inp", "bdf")),
    ("msh", by_meshio("msh", "tetra", file_format="gmsh")),
]


def read(folder: Path, kind: str, content: bytes, *changes: str) -> str:
    """Read a mesh as a scene does, and return the message; an empty string if there is none."""
    (folder / f"x.{kind}").write_bytes(content)
    (folder / "scene.toml").write_text(SCENE.format(f"x.{kind}"))

    def check() -> None:
        (body,) = read_bodies(MPI.COMM_SELF, load_scene(folder / "scene.toml", changes))
        points, triangles = body.surface.points, body.surface.triangles
        assert points.shape[1] == triangles.shape[1] == 3 and np.isfinite(points).all()
        assert 0 <= triangles.min() <= triangles.max() < len(points)

    return refusal(check)


@settings(TRIALS, max_examples=400)
@given(
    seed=st.sampled_from(SEEDS),
    changes=damage,
    step=st.sampled_from(["[]", "['merge']", "['orient']", "['union']"]),
)
def test_a_damaged_mesh_is_a_body_or_one_line(tmp_path, seed, changes, step):
    kind, content = seed
    read(tmp_path, kind, damaged(content, changes), f"mesh.prepare={step}")


@pytest.mark.parametrize(("kind", "content"), SEEDS)
def test_a_whole_mesh_is_read_and_a_truncated_one_refused(tmp_path, kind, content, capfd):
    path = tmp_path / f"x.{kind}"
    path.write_bytes(content)
    report = examine(read_surface(path))
    assert report.closed and report.volume == pytest.approx(
        {QUADS: 1.0, gltf(): 12.0}.get(content, 6.0)
    )
    # the remaining lines of an OBJ file may still be a mesh
    if not content.startswith((b"v ", b"#", b"mtllib")):
        assert read(tmp_path, kind, content[: len(content) * 3 // 4])
    assert capfd.readouterr() == ("", "")


def test_the_parts_of_a_gltf_are_joined_where_they_stand(tmp_path):
    scene = trimesh.Scene([BOX])
    scene.add_geometry(BOX, transform=trimesh.transformations.translation_matrix([5, 0, 0]))
    scene.export(tmp_path / "two.glb")
    for name, data in scene.export(file_type="gltf").items():
        (tmp_path / name).write_bytes(data)
    for name in ("two.glb", "model.gltf"):
        surface = read_surface(tmp_path / name)
        assert len(surface.triangles) == 24
        assert examine(surface).volume == pytest.approx(12)
        assert np.ptp(surface.points, axis=0) == pytest.approx([6, 2, 3])


PLY = (
    "ply\nformat {} 1.0\nelement vertex {}\nproperty {} x\nproperty {} y\nproperty {} z\n"
    "element face {}\n"
)
PLY += "property list uchar int vertex_indices\nend_header\n"


def ply(points: int, faces: int, rows: str = "", kind: str = "ascii") -> bytes:
    return (PLY.format(kind, points, *["float"] * 3, faces) + rows).encode()


def test_polygons_are_cut_into_triangles(tmp_path):
    """A prism of two triangles and three quads has the volume 1/2."""
    points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1)]
    faces = [(0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)]
    text_points = [" ".join(map(str, p)) for p in points]
    rows = [" ".join(map(str, (len(f), *f))) for f in faces]
    obj = [f"v {p}" for p in text_points] + ["f " + " ".join(str(i + 1) for i in f) for f in faces]
    packed = b"".join(struct.pack(f"<B{len(f)}i", len(f), *f) for f in faces)
    contents = {
        "ascii.ply": ply(6, 5, "\n".join(text_points + rows)),
        "binary.ply": ply(6, 5, kind="binary_little_endian")
        + struct.pack("<18f", *sum(points, ()))
        + packed,
        "prism.obj": "\n".join(obj).encode(),
        "prism.off": "\n".join(["OFF", "6 5 0", *text_points, *rows]).encode(),
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        report = examine(read_surface(tmp_path / name))
        assert report.closed and report.volume == pytest.approx(0.5), name


def box_in_obj(line: str = "{}\n", face: str = "f {} {} {}", first: int = 1) -> str:
    """Return a box as OBJ lines, each passed through ``line``; point numbers begin at ``first``."""
    rows = ["v {} {} {}".format(*point) for point in BOX.vertices]
    rows += [face.format(*corners) for corners in BOX.faces + first]
    return "".join(line.format(row) for row in rows)


WRITTEN = {
    "relative texture numbers": "vt 0 0\n" * 8
    + box_in_obj(face="f {0}/{0} {1}/{1} {2}/{2}", first=-8),
    "relative normal numbers": "vn 0 0 1\n" * 8
    + box_in_obj(face="f {0}//{0} {1}//{1} {2}//{2}", first=-8),
    "comments at line ends": box_in_obj("{} # f 1 2 3\n"),
    "tabs": box_in_obj("{}\n").replace(" ", "\t"),
    "spaces before and behind": box_in_obj(" {} \n"),
    "lines of a Mac": box_in_obj("{}\r"),
    "lines of Windows": "\ufeff" + box_in_obj("{}\r\n"),
    "lines that go on": box_in_obj().replace(" ", " \\\n"),
    "a colour a point": box_in_obj(face="f {} {} {}")
    .replace("\nv", " 1 0 0\nv")
    .replace("\nf", " 1 0 0\nf", 1),
    "colours of some points": box_in_obj().replace("\nv", " 1 0 0\nv", 3),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_an_obj_is_read_as_programs_write_it(tmp_path, name):
    (tmp_path / "box.obj").write_text(WRITTEN[name], newline="")
    surface = read_surface(tmp_path / "box.obj")
    report = examine(surface)
    assert len(surface.triangles) == 12 and report.closed and report.volume == pytest.approx(6)


def test_relative_numbers_of_an_obj_count_from_where_they_stand(tmp_path):
    box = box_in_obj(first=-8)
    (tmp_path / "boxes.obj").write_text(2 * box)
    assert np.array_equal(
        read_surface(tmp_path / "boxes.obj").triangles, np.vstack([BOX.faces, BOX.faces + 8])
    )
    (tmp_path / "early.obj").write_text(box.replace("f -8", "f -9"))
    assert "outside 0..7: -1" in refusal(lambda: read_surface(tmp_path / "early.obj"))


TRIANGLE = "0 0 0\n1 0 0\n0 1 0\n"
REFUSED = {
    "10^12 points": ("ply", ply(10**12, 1), "0 of 1000000000000 vertex rows"),
    "10^12 triangles": ("stl", bytes(80) + b"\xff\xff\xff\xff" + bytes(50), "holds no triangles"),
    "a single coordinate each": ("obj", b"v 1\nv 2\nv 3\nf 1 2 3\n", "not of three numbers each"),
    "control characters": ("ply", b"ply\nformat ascii 1.0\n\x1b[31m 3\nend_header\n", "x.ply"),
    "one point": ("obj", b"v 0 0 0\nf 1 1 1\n", "fewer than four points"),
    "lists for coordinates": (
        "ply",
        b"ply\nformat ascii 1.0\nelement vertex 3\nproperty list uchar float x\n"
        b"property list uchar float y\n"
        b"property list uchar float z\nelement face 1\nproperty list uchar int vertex_indices\n"
        b"end_header\n"
        b"1 0 1 0 1 0\n2 0 0 1 0 1 0\n1 0 1 0 1 0\n3 0 1 2\n", "x.ply",
    ),
    "nothing": ("ply", b"", "is empty"),
    "a page": ("vtu", b"<html><body>404</body></html>", "not a readable VTU"),
    "words": ("obj", b"hello\nworld\n", "no triangles"),
    "point 0": ("obj", b"v 0 0 0\nv 1 0 0\nf 0 1 2\nv 0 1 0\n", "outside 0..2: -1"),
    "not a number": ("ply", ply(3, 1, "0 0 0\n1 nan 0\n0 1 0\n3 0 1 2\n"), "NaN or infinite"),
    "no such point": ("ply", ply(3, 1, TRIANGLE + "3 0 1 7\n"), "outside 0..2: 7"),
    "too few rows": ("ply", ply(3, 2, TRIANGLE + "3 0 1 2\n"), "1 of 2 face rows"),
    "a document": ("docx", b"PK", "not a mesh format"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_in_one_line_that_names_the_file(tmp_path, name, capfd):
    kind, content, words = REFUSED[name]
    said = read(tmp_path, kind, content)
    assert words in said and (f"x.{kind}" in said or name == "one point")
    assert capfd.readouterr() == ("", "")


def test_what_is_no_file_is_refused(tmp_path):
    (tmp_path / "folder.ply").mkdir()
    for name, words in {
        "none": "No such file",
        "folder": "Is a directory",
    }.items():
        assert words in refusal(lambda name=name: read_surface(tmp_path / f"{name}.ply"))


def test_what_crashes_the_repair_library_is_refused_before():
    points, triangles = np.array(BOX.vertices), np.array(BOX.faces, np.int64)
    points[3, 1] = -4e27
    with pytest.raises(InputError, match=r"coordinates beyond 1e[+]12"):
        repair(Surface(points, triangles))


@pytest.fixture(scope="module")
def opened():
    """Return a list of the files that are opened from now on; audit hooks cannot be removed."""
    names: list[str] = []
    sys.addaudithook(lambda event, given: names.append(str(given[0])) if event == "open" else None)
    return names


NAMES_OTHERS = {
    "obj": QUADS + b"usemtl x\nmap_Kd ../texture.png\n",
    "ply": exported(file_type="ply", encoding="ascii").replace(
        b"element vertex", b"comment TextureFile paint.mtl\nelement vertex"
    ),
}


@pytest.mark.parametrize("kind", NAMES_OTHERS)
def test_a_mesh_opens_no_other_file(tmp_path, opened, kind):
    (tmp_path / "paint.mtl").write_text("newmtl x\nmap_Kd texture.png\n")
    (tmp_path / f"x.{kind}").write_bytes(NAMES_OTHERS[kind])
    opened.clear()
    assert len(read_surface(tmp_path / f"x.{kind}").triangles) == 12
    assert [name for name in opened if str(tmp_path) in name] == [str(tmp_path / f"x.{kind}")]
