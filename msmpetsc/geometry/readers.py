"""Reading of surface meshes from files, which may be damaged or hostile."""

import resource
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import BytesIO, StringIO, TextIOWrapper
from pathlib import Path

import numpy as np
import psutil
import trimesh
from trimesh.resolvers import FilePathResolver

from msmpetsc.backend.arrays import Array, Indices, Positions
from msmpetsc.errors import InputError, one_line
from msmpetsc.geometry.surface import Surface
from msmpetsc.scene.reading import lies_below

Arrays = tuple[Array, Array]  # points (v, 3), faces (f, 3 or 4)

LEAST, MOST = 2**28, 50  # memory that reading a file may take: so many bytes, or times its own


def read_surface(path: str | Path) -> Surface:
    """Read PLY, OBJ, STL, OFF, GLB, glTF, mz3, VTU or VTK as triangles, in the file's own unit.

    Polygons are cut into triangles, the parts of a GLB are joined, of tetrahedra the outer
    surface is taken.

    Raises InputError, one line naming the file, if it holds no usable mesh.
    """
    path = Path(path)
    kind, data = _kind(path), _content(path)
    try:
        with _silence(), _bounded_memory(max(LEAST, MOST * len(data))):
            points, faces = _READERS[kind](path, data)
            if faces.ndim != 2 or faces.shape[1] != 3:
                faces = trimesh.geometry.triangulate_quads(faces)
    except ModuleNotFoundError:  # a reader's package: says which extra brings it
        raise
    except MemoryError:
        raise InputError(f"{path}: reading it takes more memory than {kind.upper()} of its size can need") from None
    except Exception as error:  # on garbage the readers raise whatever comes
        reason = one_line(error, 120)
        raise InputError(f"{path}: not a readable {kind.upper()} mesh ({reason})") from error
    _check_arrays(path, points, faces)
    return Surface(np.ascontiguousarray(points, np.float64), np.ascontiguousarray(faces, np.int64))


def _check_arrays(path: Path, points: Positions, triangles: Indices) -> None:
    """Raise InputError unless the arrays make a mesh."""
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
    """Return the format by the file's name; raise InputError if it is not one we read."""
    kind = path.suffix.lower().removeprefix(".")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is a folder, a pipe or a device, not a mesh file")
    if kind not in _READERS:
        raise InputError(f"{path}: not a mesh format that is read here ({', '.join(_READERS)})")
    return kind


def _content(path: Path) -> bytes:
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
    """Suppress what readers print or warn; half-read numbers are errors."""
    with warnings.catch_warnings(), redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message="string or file could not be read")
        yield


@contextmanager
def _bounded_memory(most: int) -> Iterator[None]:
    """Raise MemoryError where this process takes ``most`` [byte] more: files may claim or pack more than they hold."""
    limits = resource.getrlimit(resource.RLIMIT_DATA)
    bounds = [psutil.Process().memory_info().data + most, *(x for x in limits if x != resource.RLIM_INFINITY)]
    resource.setrlimit(resource.RLIMIT_DATA, (min(bounds), limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, limits)


def _read_ply(path: Path, data: bytes) -> Arrays:
    try:
        mesh = trimesh.exchange.ply.load_ply(BytesIO(data), fix_texture=False, skip_materials=True)
    except ValueError as error:
        if "unexpected length" not in str(error):
            raise
        return _read_mixed_ply(data)
    stored = mesh["metadata"]["_ply_raw"]
    for name in ("vertex", "face"):  # a truncated ASCII file just has fewer rows
        rows = stored.get(name, {}).get("data", ())
        rows = next(iter(rows.values())) if isinstance(rows, dict) else rows
        if len(rows) != stored.get(name, {}).get("length", 0):
            raise ValueError(f"truncated: {len(rows)} of {stored[name]['length']} {name} rows")
    faces = mesh.get("faces")
    return mesh.get("vertices", np.zeros((0, 3))), np.zeros((0, 3)) if faces is None else faces


def _read_mixed_ply(data: bytes) -> Arrays:
    """Read a binary PLY whose faces differ in number of corners, which trimesh does not read."""
    import meshio  # a slow import for what few scenes name

    mesh = meshio.ply.read(BytesIO(data))
    polygons = [face for block in mesh.cells for face in block.data]
    return mesh.points, trimesh.geometry.triangulate_quads(polygons)


def _read_obj(path: Path, data: bytes) -> Arrays:
    """Read points and polygons of an OBJ; a negative number counts back from the newest point.

    trimesh and meshio take relative numbers as absolute and refuse tabs or comments at line ends.
    """
    points: list[list[float]] = []
    polygons: list[list[int]] = []
    text = TextIOWrapper(BytesIO(data), "utf-8-sig", "replace").read().replace("\\\n", " ")
    for line in StringIO(text):
        key, *words = line.partition("#")[0].split() or [""]
        if key == "v":
            points.append([float(word) for word in words[:3]])
        elif key == "f":
            corners = [int(word.partition("/")[0]) for word in words]
            # 0 is no point's number: it becomes -1, which is refused
            polygons.append([n - 1 if n >= 0 else len(points) + n for n in corners])
    return np.array(points), np.reshape(trimesh.geometry.triangulate_quads(polygons), (-1, 3))


class _FolderResolver(FilePathResolver):
    """Reads the files that a glTF names: those in its folder or below it, links followed, and no others."""

    def get(self, name: str) -> bytes:
        """Return the content of a named file; ValueError if it is none that may be read."""
        path = Path(self.parent, name)
        if not lies_below(Path(self.parent), name) or not path.is_file():
            raise ValueError(f"it names {name}, which is no file in its folder")
        return path.read_bytes()


def _read_trimesh(path: Path, data: bytes) -> Arrays:
    kind = _kind(path)
    scene = trimesh.load_scene(
        BytesIO(data),
        file_type=kind,
        resolver=_FolderResolver(str(path)),
        process=False,
        skip_materials=True,
        maintain_order=True,
    )
    if not scene.geometry:
        return np.zeros((0, 3)), np.zeros((0, 3))
    mesh = scene.to_mesh()
    return mesh.vertices, mesh.faces


def _read_meshio(path: Path, data: bytes) -> Arrays:
    """Read the outer surface of tetrahedra, or else triangles and quads, without unused points."""
    import meshio

    mesh = {"vtu": meshio.vtu, "vtk": meshio.vtk}[_kind(path)].read(path)
    cells = mesh.cells_dict
    if "tetra" in cells:
        triangles = _outer_triangles(mesh.points, cells["tetra"])
    else:
        quads = cells.get("quad", np.zeros((0, 4), np.int64))
        triangles = np.vstack([cells.get("triangle", np.zeros((0, 3), np.int64)), quads[:, :3], quads[:, [2, 3, 0]]])
    used, triangles = np.unique(triangles, return_inverse=True)
    return mesh.points[used], triangles.reshape(-1, 3)


def _outer_triangles(points: Positions, tetrahedra: Indices) -> Indices:
    """Return the faces (f, 3) of one tetrahedron only, wound outwards, of tetrahedra (c, 4)."""
    a, b, c, d = points[tetrahedra].swapaxes(0, 1)
    inverted = np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) < 0
    tetrahedra = np.where(inverted[:, None], tetrahedra[:, [0, 2, 1, 3]], tetrahedra)
    faces = tetrahedra[:, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer: Indices = np.sort(first[count == 1])
    return faces[outer]


def _read_mz3(path: Path, data: bytes) -> Arrays:
    """Read the mz3 of Surf Ice: 16 bytes of header, int32 triangles, float32 points."""
    magic, content, faces, points, skip = struct.unpack_from("<HHIII", data)
    if magic != 0x5A4D or content & 3 != 3:  # bits 0 and 1: has triangles, has points
        raise ValueError("no mz3 header with triangles and points")
    start = 16 + skip
    triangles = np.frombuffer(data, "<i4", 3 * faces, start)
    coordinates = np.frombuffer(data, "<f4", 3 * points, start + triangles.nbytes)
    return coordinates.reshape(-1, 3), triangles.reshape(-1, 3)


_READERS = {
    "ply": _read_ply,
    "mz3": _read_mz3,
    "vtu": _read_meshio,
    "vtk": _read_meshio,
    "obj": _read_obj,
    **dict.fromkeys(("stl", "off", "glb", "gltf"), _read_trimesh),
}
