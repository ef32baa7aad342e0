"""Files of meshio: the boundary of their cells, and the sets of cells and points that they name."""

from collections.abc import Iterator, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions

if TYPE_CHECKING:
    import meshio

Groups = dict[str, Indices]  # by name, triangles (f, 3)

# distinct labels of an array [-]; one that has more numbers cells, and names no parts
MOST_LABELS = 1000
# lines behind a text's end [-]; a reader that comes to its end asks for few
PATIENCE = 100


class Kind(NamedTuple):
    """A kind of cell, with corners, edges and faces as VTK numbers them.

    faces     : corners of each face, in order around it
    edges     : corners of each edge, in the order of the nodes at their middles
    quadratic : numbers of nodes of cells that have nodes on their edges; meshio has no such wedge
    """

    dimension: int
    faces: tuple[str, ...]
    edges: tuple[str, ...] = ()
    quadratic: tuple[int, ...] = ()

    def triangles(self, cells: Indices, face: str) -> Indices:
        """Return the triangles (c, t, 3) of one face of cells (c, k)."""
        ring = [int(corner) for corner in face]
        if cells.shape[1] in self.quadratic:
            first, edges = 1 + int(max(map(max, self.faces))), [{*edge} for edge in self.edges]
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
# Triangles of a face by how many nodes are around it; of 6 and 8 every second is an edge's middle.
CUTS = {
    3: [[0, 1, 2]],
    4: [[0, 1, 2], [2, 3, 0]],
    6: [[0, 1, 5], [1, 2, 3], [3, 4, 5], [1, 3, 5]],
    8: [[0, 1, 7], [1, 2, 3], [3, 4, 5], [5, 6, 7], [1, 3, 5], [1, 5, 7]],
}


Blocks = Sequence[tuple[Kind | None, Indices]]  # cells (c, k); of no kind if they have no face


def read_cells(path: Path, data: bytes) -> tuple[Positions, Indices, Groups]:
    """Return points (v, 3), triangles (f, 3) and named triangles of a file that meshio reads.

    The triangles are the boundary of the cells that have a volume, or else the triangles and quads.
    """
    # a slow import for formats that few scenes name
    import meshio

    if path.suffix.lower() == ".inp" and b"*INCLUDE" in data.upper():
        raise ValueError("it includes other files, which are not read")
    texts, binary = (
        {".inp": meshio.abaqus, ".bdf": meshio.nastran},
        {".vtu": meshio.vtu, ".vtk": meshio.vtk},
    )
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
    triangles = boundary(points, blocks) if solid else _flat(blocks)
    groups: dict[str, list[Indices]] = {}
    for name, rows in _sets(mesh, blocks):
        named = [(kind, cells[own]) for (kind, cells), own in zip(blocks, rows, strict=True)]
        groups.setdefault(name, []).extend((boundary(points, named), _flat(named)))
    for name, numbers in mesh.point_sets.items():
        groups.setdefault(name, []).append(triangles[np.isin(triangles, numbers).all(axis=1)])
    return points, triangles, {name: np.concatenate(parts) for name, parts in groups.items()}


class _Lines(StringIO):
    """A text that is an error to readers which ask for more and more lines behind its end."""

    behind = 0

    def readline(self, size: int = -1, /) -> str:  # type: ignore[override]
        line = super().readline(size)
        self.behind += not line
        if self.behind > PATIENCE:
            raise EOFError("it ends too early")
        return line


def _kind(name: str) -> Kind | None:
    """Return the kind of cell of meshio's name, "tetra10".

    Raises ValueError if it is not read.
    """
    base = name.rstrip("0123456789")
    if base not in KINDS and base not in ("vertex", "line"):
        raise ValueError(f"cells of kind {name} are not read")
    return KINDS.get(base)


def _sets(mesh: "meshio.Mesh", blocks: Blocks) -> Iterator[tuple[str, list[Indices]]]:
    """Yield the name and the rows of each block of the sets of cells that a mesh names or labels."""
    for name, rows in mesh.cell_sets.items():
        if not name.startswith("gmsh:"):
            yield name, [np.asarray(own, np.int64) for own in rows]
    arrays = {
        key: np.concatenate(parts)
        for key, parts in mesh.cell_data.items()
        if key != "gmsh:geometrical"
    }
    dimensions = np.repeat(
        [kind.dimension if kind else 0 for kind, _ in blocks], [len(cells) for _, cells in blocks]
    )
    ends = np.cumsum([len(cells) for _, cells in blocks])
    for key, label, usual in labels_of(
        {key: each for key, each in arrays.items() if each.shape == dimensions.shape}
    ):
        # in which a name is of a label and a dimension, and 0 is no group
        is_gmsh = key == "gmsh:physical"
        names = (
            {(int(tag), int(size)): name for name, (tag, size) in mesh.field_data.items()}
            if is_gmsh
            else {}
        )
        for dimension in (2, 3) if label or not is_gmsh else ():
            own = (arrays[key] == label) & (dimensions == dimension)
            yield (
                names.get((label, dimension), usual),
                [*map(np.flatnonzero, np.split(own, ends[:-1]))],
            )


def labels_of(arrays: Mapping[str, Array]) -> Iterator[tuple[str, int, str]]:
    """Yield array, label and name of each label in arrays of whole numbers.

    The name is "3", or "array:3" if there are several arrays.
    """
    whole = {key: values for key, values in arrays.items() if values.dtype.kind in "iu"}
    for key, values in whole.items():
        labels = np.unique(values)
        for label in map(int, labels[: len(labels) * (len(labels) <= MOST_LABELS)]):
            yield key, label, str(label) if len(whole) == 1 else f"{key}:{label}"


def _flat(blocks: Blocks) -> Indices:
    """Return the triangles (f, 3) of cells without volume."""
    flat = [(kind, cells) for kind, cells in blocks if kind and kind.dimension == 2]
    parts = [kind.triangles(cells, kind.faces[0]).reshape(-1, 3) for kind, cells in flat]
    return np.concatenate([np.zeros((0, 3), np.int64), *parts])


def boundary(points: Positions, blocks: Blocks) -> Indices:
    """Return the faces of one cell only as triangles (f, 3), wound outwards.

    The cell itself may be inverted.
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
    ordered = np.concatenate(keys)[order := np.lexsort(np.concatenate(keys).T)]
    same = (ordered[1:] == ordered[:-1]).all(axis=1)
    outer = np.ones(len(order), bool)
    outer[order[1:][same]] = outer[order[:-1][same]] = False
    parts, ends = [np.zeros((0, 3), np.int64)], np.cumsum([len(key) for key in keys])
    for (face, kind, cells, inverted), own in zip(
        faces, np.split(outer, ends[:-1])[1:], strict=True
    ):
        triangles = kind.triangles(cells[own], face)
        parts.append(
            np.where(inverted[own][:, None, None], triangles[:, :, ::-1], triangles).reshape(-1, 3)
        )
    triangles = np.concatenate(parts)
    whole: Indices = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    return whole


def _key(corners: Indices) -> Indices:
    """Return the corners of faces in order, (f, 4), each once, with -1 in front of fewer."""
    key = np.sort(corners, axis=1)
    # a collapsed cell has a corner twice
    key[:, 1:][key[:, 1:] == key[:, :-1]] = -1
    return np.pad(np.sort(key, axis=1), ((0, 0), (4 - key.shape[1], 0)), constant_values=-1)


def _volumes(points: Positions, kind: Kind, cells: Indices) -> Floats:
    """Return the signed volume (c,) of cells, negative if they are inverted [m^3]."""
    volumes = np.zeros(len(cells))
    for face in kind.faces:
        a, b, c = np.moveaxis(
            points[kind.triangles(cells, face)] - points[cells[:, :1], None], 2, 0
        )
        volumes += np.einsum("cti,cti->c", a, np.cross(b, c)) / 6
    return volumes
