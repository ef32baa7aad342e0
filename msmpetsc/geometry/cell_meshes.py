"""Read meshes of cells by meshio: boundary triangles, and named sets of cells and points."""

from collections.abc import Iterator, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions

if TYPE_CHECKING:
    import meshio

# triangles (f, 3) by the name of their group
Groups = dict[str, Indices]

# most labels of an array of groups [-]; an array with more labels numbers the cells
MOST_LABELS = 1000
# most lines asked for past the end of a text [-]; readers of intact files ask for few
MOST_LINES_PAST_END = 100


class Kind(NamedTuple):
    """A kind of cell, with corners, edges and faces as VTK numbers them.

    faces     : corners of each face, in order around it
    edges     : corners of each edge, in the order of the mid-edge nodes
    quadratic : node counts of cells with mid-edge nodes; meshio reads no such pyramids and wedges
    """

    dimension: int
    faces: tuple[str, ...]
    edges: tuple[str, ...] = ()
    quadratic: tuple[int, ...] = ()

    def triangles(self, cells: Indices, face: str) -> Indices:
        """Return the triangles (c, t, 3) of a face of cells (c, k)."""
        ring = [int(corner) for corner in face]
        if cells.shape[1] in self.quadratic:
            first = 1 + int(max(map(max, self.faces)))
            edges = [{*edge} for edge in self.edges]
            middles = [
                first + edges.index({*pair}) for pair in zip(face, face[1:] + face[0], strict=True)
            ]
            ring = [node for pair in zip(ring, middles, strict=True) for node in pair]
        triangles: Indices = cells[:, np.array(ring)[CUTS[len(ring)]]]
        return triangles


KINDS = {
    "triangle": Kind(2, ("012",), ("01", "12", "20"), (6, 7)),
    "quad": Kind(2, ("0123",), ("01", "12", "23", "30"), (8, 9)),
    "tetra": Kind(3, ("021", "013", "123", "032"), ("01", "12", "20", "03", "13", "23"), (10,)),
    "pyramid": Kind(3, ("0321", "014", "124", "234", "304")),
    "wedge": Kind(3, ("021", "345", "0143", "1254", "2035")),
    "hexahedron": Kind(
        3,
        ("0321", "4567", "0154", "1265", "2376", "3047"),
        ("01", "12", "23", "30", "45", "56", "67", "74", "04", "15", "26", "37"),
        (20, 27),
    ),
}
# triangles of a face by its number of nodes; with 6 or 8 nodes every second is mid-edge
CUTS = {
    3: [[0, 1, 2]],
    4: [[0, 1, 2], [2, 3, 0]],
    6: [[0, 1, 5], [1, 2, 3], [3, 4, 5], [1, 3, 5]],
    8: [[0, 1, 7], [1, 2, 3], [3, 4, 5], [5, 6, 7], [1, 3, 5], [1, 5, 7]],
}


# kind and cells (c, k) of each block; None for vertices and lines
MeshBlocks = Sequence[tuple[Kind | None, Indices]]


def read_cells(path: Path, data: bytes) -> tuple[Positions, Indices, Groups]:
    """Return points (v, 3), triangles (f, 3) and named triangles of a file that meshio reads.

    The triangles are the boundary of the volume cells, or the file's triangles and quads if there
    are no volume cells.
    """
    # imported here because it is slow and few scenes need it
    import meshio

    if path.suffix.lower() == ".inp" and b"*INCLUDE" in data.upper():
        raise ValueError("it includes other files, which are not read")
    texts = {".inp": meshio.abaqus, ".bdf": meshio.nastran}
    binary = {".vtu": meshio.vtu, ".vtk": meshio.vtk}
    if reader := texts.get(path.suffix.lower()):
        mesh = reader.read(_Lines(data.decode(errors="replace")))
    else:
        mesh = binary.get(path.suffix.lower(), meshio.gmsh).read(path)
    points = np.asarray(mesh.points, np.float64)
    blocks = [(_kind(block.type), np.asarray(block.data, np.int64)) for block in mesh.cells]
    for _, cells in blocks:
        if cells.size and not 0 <= cells.min() <= cells.max() < len(points):
            raise ValueError(f"a cell names a point outside 0..{len(points) - 1}")
    solid = any(kind and kind.dimension == 3 for kind, _ in blocks)
    triangles = boundary(points, blocks) if solid else _shell_triangles(blocks)
    groups: dict[str, list[Indices]] = {}
    for name, rows in _sets(mesh, blocks):
        named = [(kind, cells[chosen]) for (kind, cells), chosen in zip(blocks, rows, strict=True)]
        groups.setdefault(name, []).extend((boundary(points, named), _shell_triangles(named)))
    for name, numbers in mesh.point_sets.items():
        groups.setdefault(name, []).append(triangles[np.isin(triangles, numbers).all(axis=1)])
    return points, triangles, {name: np.concatenate(parts) for name, parts in groups.items()}


class _Lines(StringIO):
    """A text that raises EOFError if a reader asks for many lines past its end.

    Without it, meshio's readers would not return from some damaged texts.
    """

    lines_past_end = 0

    def readline(self, size: int = -1, /) -> str:  # type: ignore[override]
        line = super().readline(size)
        self.lines_past_end += not line
        if self.lines_past_end > MOST_LINES_PAST_END:
            raise EOFError("it ends too early")
        return line


def _kind(name: str) -> Kind | None:
    """Return the kind of cell by meshio's name, such as "tetra10"; None for vertices and lines.

    Raises ValueError for any other cell.
    """
    base = name.rstrip("0123456789")
    if base not in KINDS and base not in ("vertex", "line"):
        raise ValueError(f"cells of kind {name} are not read")
    return KINDS.get(base)


def _sets(mesh: "meshio.Mesh", blocks: MeshBlocks) -> Iterator[tuple[str, list[Indices]]]:
    """Yield the name of each named or labelled set of cells, and its rows in each block."""
    for name, rows in mesh.cell_sets.items():
        if not name.startswith("gmsh:"):
            yield name, [np.asarray(of_block, np.int64) for of_block in rows]
    arrays = {
        key: np.concatenate(parts)
        for key, parts in mesh.cell_data.items()
        if key != "gmsh:geometrical"
    }
    dimensions = np.repeat(
        [kind.dimension if kind else 0 for kind, _ in blocks], [len(cells) for _, cells in blocks]
    )
    ends = np.cumsum([len(cells) for _, cells in blocks])
    for key, label, default_name in labels_of(
        {key: each for key, each in arrays.items() if each.shape == dimensions.shape}
    ):
        # gmsh gives a name to a pair of label and dimension; label 0 means no group
        is_gmsh = key == "gmsh:physical"
        names = (
            {(int(tag), int(size)): name for name, (tag, size) in mesh.field_data.items()}
            if is_gmsh
            else {}
        )
        for dimension in (2, 3) if label or not is_gmsh else ():
            in_group = (arrays[key] == label) & (dimensions == dimension)
            yield (
                names.get((label, dimension), default_name),
                [*map(np.flatnonzero, np.split(in_group, ends[:-1]))],
            )


def labels_of(arrays: Mapping[str, Array]) -> Iterator[tuple[str, int, str]]:
    """Yield array, label and name of each label in arrays of integers.

    The name is "3", or "array:3" if there are several arrays.
    """
    whole = {key: values for key, values in arrays.items() if values.dtype.kind in "iu"}
    for key, values in whole.items():
        labels = np.unique(values)
        for label in map(int, labels[: len(labels) * (len(labels) <= MOST_LABELS)]):
            yield key, label, str(label) if len(whole) == 1 else f"{key}:{label}"


def _shell_triangles(blocks: MeshBlocks) -> Indices:
    """Return the triangles (f, 3) of triangle and quad cells."""
    shells = [(kind, cells) for kind, cells in blocks if kind and kind.dimension == 2]
    parts = [kind.triangles(cells, kind.faces[0]).reshape(-1, 3) for kind, cells in shells]
    return np.concatenate([np.zeros((0, 3), np.int64), *parts])


def boundary(points: Positions, blocks: MeshBlocks) -> Indices:
    """Return the faces that belong to a single cell as triangles (f, 3), wound outwards.

    Faces of an inverted cell are reversed.
    """
    solid = [
        (kind, cells, _volumes(points, kind, cells) < 0)
        for kind, cells in blocks
        if kind and kind.dimension == 3
    ]
    faces = [(face, *of_kind) for of_kind in solid for face in of_kind[0].faces]
    keys = [
        np.zeros((0, 4), np.int64),
        *(_key(cells[:, [*map(int, face)]]) for face, _, cells, _ in faces),
    ]
    _, place, uses = np.unique(
        np.concatenate(keys), axis=0, return_inverse=True, return_counts=True
    )
    outer = uses[place.ravel()] == 1
    parts = [np.zeros((0, 3), np.int64)]
    ends = np.cumsum([len(key) for key in keys])
    for (face, kind, cells, inverted), is_outer in zip(
        faces, np.split(outer, ends[:-1])[1:], strict=True
    ):
        triangles = kind.triangles(cells[is_outer], face)
        turned = inverted[is_outer][:, None, None]
        parts.append(np.where(turned, triangles[:, :, ::-1], triangles).reshape(-1, 3))
    triangles = np.concatenate(parts)
    proper: Indices = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    return proper


def _key(corners: Indices) -> Indices:
    """Return the distinct corners of faces in ascending order, (f, 4), padded with -1 in front."""
    key = np.sort(corners, axis=1)
    # a collapsed cell repeats a corner
    key[:, 1:][key[:, 1:] == key[:, :-1]] = -1
    return np.pad(np.sort(key, axis=1), ((0, 0), (4 - key.shape[1], 0)), constant_values=-1)


def _volumes(points: Positions, kind: Kind, cells: Indices) -> Floats:
    """Return the signed volume [m^3] of cells, (c,): negative if a cell is inverted."""
    volumes = np.zeros(len(cells))
    for face in kind.faces:
        a, b, c = np.moveaxis(
            points[kind.triangles(cells, face)] - points[cells[:, :1], None], 2, 0
        )
        volumes += np.einsum("cti,cti->c", a, np.cross(b, c)) / 6
    return volumes
