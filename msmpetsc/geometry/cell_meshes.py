"""Files of meshio: the boundary of their cells, and the sets of cells and points that they name."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions

if TYPE_CHECKING:
    import meshio

Groups = dict[str, Indices]  # by name, triangles (f, 3)

# distinct labels of an array [-]; one that has more numbers cells, and names no parts
MOST_LABELS = 1000


class Kind(NamedTuple):
    """A kind of cell, with corners, edges and faces as VTK numbers them.

    faces     : corners of each face, in order around it
    edges     : corners of each edge, in the order of the nodes at their middles
    quadratic : numbers of nodes of cells that have nodes on their edges; meshio has no such wedge
    """

    dimension: int
    faces: tuple[tuple[int, ...], ...]
    edges: tuple[tuple[int, int], ...] = ()
    quadratic: tuple[int, ...] = ()

    def triangles(self, cells: Indices, face: tuple[int, ...]) -> Indices:
        """Return the triangles (c, t, 3) of one face of cells (c, k)."""
        ring = [*face]
        if cells.shape[1] in self.quadratic:
            first = 1 + max(map(max, self.faces))
            ends = [{*pair} for pair in zip(face, face[1:] + face[:1], strict=True)]
            middles = [first + [{*edge} for edge in self.edges].index(pair) for pair in ends]
            ring = [node for pair in zip(face, middles, strict=True) for node in pair]
        triangles: Indices = cells[:, np.array(ring)[CUTS[len(ring)]]]
        return triangles


KINDS = {
    "triangle": Kind(2, ((0, 1, 2),), ((0, 1), (1, 2), (2, 0)), (6, 7)),
    "quad": Kind(2, ((0, 1, 2, 3),), ((0, 1), (1, 2), (2, 3), (3, 0)), (8, 9)),
    "tetra": Kind(
        3,
        ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)),
        ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)),
        (10,),
    ),
    "pyramid": Kind(3, ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4))),
    "wedge": Kind(3, ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5))),
    "hexahedron": Kind(
        3,
        ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
        (
            *((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4)),
            *((0, 4), (1, 5), (2, 6), (3, 7)),
        ),
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
    import meshio  # a slow import for formats that few scenes name

    if path.suffix.lower() == ".inp" and b"*INCLUDE" in data.upper():
        raise ValueError("it includes other files, which are not read")
    formats = {"vtu": meshio.vtu, "vtk": meshio.vtk, "msh": meshio.gmsh, "inp": meshio.abaqus}
    mesh = formats.get(path.suffix.lower().removeprefix("."), meshio.nastran).read(path)
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


def _kind(name: str) -> Kind | None:
    """Return the kind of cell of meshio's name, "tetra10". Raises ValueError for one that is not read."""
    base = name.rstrip("0123456789")
    if base not in KINDS and base not in ("vertex", "line"):
        raise ValueError(f"cells of kind {name} are not read")
    return KINDS.get(base)


def _sets(mesh: "meshio.Mesh", blocks: Blocks) -> Iterator[tuple[str, list[Indices]]]:
    """Yield the sets of cells that a mesh names: their names, and the rows of each block.

    A label of an array of whole numbers is a name, too: "3", or "array:3" if several arrays have labels.
    """
    for name, rows in mesh.cell_sets.items():
        if not name.startswith("gmsh:"):
            yield name, [np.asarray(own, np.int64) for own in rows]
    arrays = {key: [np.asarray(part) for part in parts] for key, parts in mesh.cell_data.items()}
    arrays = {
        key: parts
        for key, parts in arrays.items()
        if key != "gmsh:geometrical" and all(part.dtype.kind in "iu" and part.ndim == 1 for part in parts)
    }
    for key, parts in arrays.items():
        is_gmsh = key == "gmsh:physical"
        names = {(int(tag), int(size)): name for name, (tag, size) in mesh.field_data.items()} if is_gmsh else {}
        labels = np.unique(np.concatenate(parts))
        for label in map(int, labels[: len(labels) * (len(labels) <= MOST_LABELS)]):
            for dimension in (2, 3):
                rows = [
                    np.flatnonzero((part == label) & (kind is not None and kind.dimension == dimension))
                    for (kind, _), part in zip(blocks, parts, strict=True)
                ]
                if any(map(len, rows)) and not (is_gmsh and label == 0):  # gmsh's 0 is no group
                    usual = str(label) if len(arrays) == 1 else f"{key}:{label}"
                    yield names.get((label, dimension), usual), rows


def _flat(blocks: Blocks) -> Indices:
    """Return the triangles (f, 3) of cells without volume."""
    parts = [
        kind.triangles(cells, kind.faces[0]).reshape(-1, 3)
        for kind, cells in blocks
        if kind is not None and kind.dimension == 2
    ]
    return np.concatenate([np.zeros((0, 3), np.int64), *parts])


def boundary(points: Positions, blocks: Blocks) -> Indices:
    """Return the faces of one cell only as triangles (f, 3), wound outwards also if the cell is not."""
    solid = [(kind, cells) for kind, cells in blocks if kind is not None and kind.dimension == 3]
    faces = [(kind, cells, face) for kind, cells in solid for face in kind.faces]
    keys = np.concatenate([np.zeros((0, 4), np.int64), *(_key(cells[:, face]) for _, cells, face in faces)])
    order = np.lexsort(keys.T)
    same = (keys[order][1:] == keys[order][:-1]).all(axis=1)
    outer = np.ones(len(keys), bool)
    outer[order[1:][same]] = outer[order[:-1][same]] = False
    inverted = [_volumes(points, kind, cells) < 0 for kind, cells in solid for _ in kind.faces]
    parts, start = [np.zeros((0, 3), np.int64)], 0
    for (kind, cells, face), wrong in zip(faces, inverted, strict=True):
        own = outer[start : start + len(cells)]
        triangles = kind.triangles(cells[own], face)
        turned = np.where(wrong[own][:, None, None], triangles[:, :, ::-1], triangles).reshape(-1, 3)
        parts.append(turned[(turned != np.roll(turned, 1, axis=1)).all(axis=1)])
        start += len(cells)
    return np.concatenate(parts)


def _key(corners: Indices) -> Indices:
    """Return corners (f, 3 or 4) of faces in order, (f, 4), each once, with -1 in front of fewer."""
    key = np.sort(corners, axis=1)
    key[:, 1:][key[:, 1:] == key[:, :-1]] = -1  # a corner that a collapsed cell has twice
    return np.pad(np.sort(key, axis=1), ((0, 0), (4 - key.shape[1], 0)), constant_values=-1)


def _volumes(points: Positions, kind: Kind, cells: Indices) -> Floats:
    """Return the signed volume (c,) of cells, negative if they are inverted [m^3]."""
    volumes = np.zeros(len(cells))
    for face in kind.faces:
        a, b, c = np.moveaxis(points[kind.triangles(cells, face)] - points[cells[:, :1], None], 2, 0)
        volumes += np.einsum("cti,cti->c", a, np.cross(b, c)) / 6
    return volumes
