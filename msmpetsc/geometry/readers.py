"""Read surface meshes from files, which may be damaged or hostile."""

import struct
import warnings
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from io import BytesIO, StringIO, TextIOWrapper
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver

from msmpetsc.backend.arrays import Array, Indices, Positions
from msmpetsc.comm import starts
from msmpetsc.errors import InputError, one_line, refuse_pipe
from msmpetsc.geometry.cell_meshes import labels_of, read_cells
from msmpetsc.geometry.surface import Surface, compact

# points (v, 3), faces (f, 3 or 4) or a list of polygons, and the faces of each group
Arrays = tuple[Array, Any, Mapping[str, Any]]

# properties of a PLY's faces that are colours, not labels
COLOURS = ("red", "green", "blue", "alpha")


def read_surface(path: str | Path) -> Surface:
    """Read a surface, in the file's own unit, in any of the formats of ``_READERS``.

    Polygons are cut into triangles, the parts of a GLB are joined, and volume cells give their
    boundary. The surface has the groups that the file names.

    Raises InputError, a single line that names the file, if the file holds no usable mesh.
    """
    path = Path(path)
    kind = _kind(path)
    data = _content(path)
    try:
        with _silence():
            points, polygons, named = _READERS[kind](path, data)
            faces = _cut(polygons)
            groups = {name: _cut(own) for name, own in named.items()}
    # the message of a missing package names the extra that brings it
    except ModuleNotFoundError:
        raise
    # on damaged files, readers may raise any exception
    except Exception as error:
        reason = one_line(error, 120)
        raise InputError(f"{path}: not a readable {kind.upper()} mesh ({reason})") from error
    _check_arrays(path, points, faces)
    points = np.ascontiguousarray(points, np.float64)
    marked = {name: compact(points, own) for name, own in groups.items() if len(own)}
    return replace(compact(points, np.asarray(faces, np.int64)), groups=marked)


def _cut(polygons: Any) -> Indices:
    """Return polygons as triangles (f, 3)."""
    if isinstance(polygons, np.ndarray) and polygons.ndim == 2 and polygons.shape[1] == 3:
        return polygons
    return np.reshape(trimesh.geometry.triangulate_quads(polygons), (-1, 3))


def _check_arrays(path: Path, points: Positions, triangles: Indices) -> None:
    """Raise InputError unless points and triangles make a mesh."""
    if len(triangles) == 0:
        raise InputError(f"{path}: holds no triangles")
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise InputError(f"{path}: its points are not of three numbers each")
    if not np.isfinite(points).all():
        raise InputError(f"{path}: has coordinates that are NaN or infinite")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise InputError(
            f"{path}: a triangle names a point outside 0..{len(points) - 1}: "
            f"{triangles.min() if triangles.min() < 0 else triangles.max()}"
        )


def _kind(path: Path) -> str:
    """Return the format of a file by its ending. Raises InputError for an unknown ending."""
    kind = path.suffix.lower().removeprefix(".")
    if kind not in _READERS:
        raise InputError(f"{path}: not a mesh format that is read here ({', '.join(_READERS)})")
    return kind


def _content(path: Path) -> bytes:
    """Return the bytes of a file. Raises InputError if it cannot be read or is empty."""
    refuse_pipe(path)
    try:
        data = path.read_bytes()
    except (OSError, MemoryError) as error:
        reason = getattr(error, "strerror", None) or error or "too large for the memory"
        raise InputError(f"{path}: cannot be read ({reason})") from error
    if not data:
        raise InputError(f"{path}: is empty")
    return data


@contextmanager
def _silence() -> Iterator[None]:
    """Suppress the output and the warnings of readers, but raise if numpy read numbers in part."""
    with warnings.catch_warnings(), redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message="string or file could not be read")
        yield


def _read_ply(path: Path, data: bytes) -> Arrays:
    """Read points, faces and labelled faces of a PLY."""
    try:
        mesh = trimesh.exchange.ply.load_ply(BytesIO(data), fix_texture=False, skip_materials=True)
    except ValueError as error:
        if "unexpected length" not in str(error):
            raise
        return _read_mixed_ply(data)
    stored = mesh["metadata"]["_ply_raw"]
    # trimesh accepts a truncated ASCII file with fewer rows
    for name in ("vertex", "face"):
        rows = stored.get(name, {}).get("data", ())
        rows = next(iter(rows.values())) if isinstance(rows, dict) else rows
        if len(rows) != stored.get(name, {}).get("length", 0):
            raise ValueError(f"truncated: {len(rows)} of {stored[name]['length']} {name} rows")
    faces = mesh.get("faces")
    if faces is None:
        return mesh.get("vertices", np.zeros((0, 3))), np.zeros((0, 3)), {}
    return mesh["vertices"], faces, _labelled(faces, stored["face"]["data"])


def _labelled(faces: Array, data: Any) -> dict[str, Array]:
    """Return the faces (f, k) of each label in a PLY: integers of faces, except their colours."""
    names = data if isinstance(data, dict) else data.dtype.names
    # in an ASCII file such a column is (f, 1)
    columns = {name: np.ravel(data[name]) for name in names if name not in COLOURS}
    of_faces = {name: each for name, each in columns.items() if each.shape == faces.shape[:1]}
    return {name: faces[of_faces[key] == label] for key, label, name in labels_of(of_faces)}


def _read_mixed_ply(data: bytes) -> Arrays:
    """Read a binary PLY whose faces differ in number of corners, which trimesh cannot read."""
    # imported here because it is slow and few scenes need it
    import meshio

    mesh = meshio.ply.read(BytesIO(data))
    polygons = [face for block in mesh.cells for face in block.data]
    return mesh.points, trimesh.geometry.triangulate_quads(polygons), {}


def _read_obj(path: Path, data: bytes) -> Arrays:
    """Read points, polygons and groups of an OBJ.

    A negative number counts back from the newest point. trimesh and meshio read it as an absolute
    number, and refuse tabs or comments at line ends.
    """
    points: list[list[float]] = []
    polygons: list[list[int]] = []
    groups: dict[str, list[list[int]]] = {}
    current: dict[str, list[str]] = {}
    text = TextIOWrapper(BytesIO(data), "utf-8-sig", "replace").read().replace("\\\n", " ")
    for line in StringIO(text):
        key, *words = line.partition("#")[0].split() or [""]
        if key == "v":
            points.append([float(word) for word in words[:3]])
        elif key == "f":
            corners = [int(word.partition("/")[0]) for word in words]
            # 0 is no valid number: it becomes -1, which ``_check_arrays`` refuses
            polygons.append([n - 1 if n >= 0 else len(points) + n for n in corners])
            for name in {*chain.from_iterable(current.values())}:
                groups.setdefault(name, []).append(polygons[-1])
        elif key == "g":
            current[key] = words
        elif key in ("o", "usemtl"):
            current[key] = [" ".join(words)] if words else []
    return np.array(points), polygons, groups


def _read_trimesh(path: Path, data: bytes) -> Arrays:
    """Read points, triangles and named nodes by trimesh."""
    kind = _kind(path)
    scene = trimesh.load_scene(
        BytesIO(data),
        file_type=kind,
        resolver=FilePathResolver(str(path)),
        process=False,
        skip_materials=True,
        maintain_order=True,
    )
    parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
    first = starts(np.array([len(part.vertices) for part in parts], np.int64))
    parents = scene.graph.transforms.parents
    groups = defaultdict(list)
    for part, start in zip(parts, first, strict=True):
        # a part belongs to its node and to all parent nodes, which may form a cycle
        node, left = part.metadata["node"], len(parents)
        while node not in (None, scene.graph.base_frame) and left >= 0:
            # trimesh names a part without a name "geometry_..."
            if not node.startswith("geometry_"):
                groups[node].append(part.faces + start)
            node, left = parents.get(node), left - 1
    points, faces = (
        [np.zeros((0, 3)), *(getattr(part, name) for part in parts)]
        for name in ("vertices", "faces")
    )
    triangles = [of_part + start for of_part, start in zip(faces[1:], first, strict=True)]
    return (
        np.concatenate(points),
        np.concatenate([faces[0], *triangles]),
        {k: np.concatenate(v) for k, v in groups.items()},
    )


def _read_mz3(path: Path, data: bytes) -> Arrays:
    """Read an mz3 of Surf Ice: 16 bytes of header, int32 triangles, float32 points."""
    magic, content, faces, points, skip = struct.unpack_from("<HHIII", data)
    # bits 0 and 1: the file has triangles, has points
    if magic != 0x5A4D or content & 3 != 3:
        raise ValueError("no mz3 header with triangles and points")
    start = 16 + skip
    triangles = np.frombuffer(data, "<i4", 3 * faces, start)
    coordinates = np.frombuffer(data, "<f4", 3 * points, start + triangles.nbytes)
    return coordinates.reshape(-1, 3), triangles.reshape(-1, 3), {}


_READERS = {
    "ply": _read_ply,
    "mz3": _read_mz3,
    "obj": _read_obj,
    **dict.fromkeys(("vtu", "vtk", "msh", "inp", "bdf"), read_cells),
    **dict.fromkeys(("stl", "off", "glb", "gltf"), _read_trimesh),
}
