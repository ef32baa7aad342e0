"""Meshes of cells: their boundary is closed and wound outwards, and their sets become groups."""

from itertools import product
from pathlib import Path

import meshio
import numpy as np
import pytest

from msmpetsc.errors import InputError
from msmpetsc.geometry.cell_meshes import KINDS
from msmpetsc.geometry.readers import read_surface
from msmpetsc.geometry.surface import examine

# cubes along each side of 1 m
N = 2
CUBE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
# cells of a cube by its corners in VTK's order; 8 is the middle of the cube
PARTS = {
    "hexahedron": [range(8)],
    "wedge": [[0, 1, 2, 4, 5, 6], [0, 2, 3, 4, 6, 7]],
    "tetra": [[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]],
    "pyramid": [[*map(int, face), 8] for face in KINDS["hexahedron"].faces],
}
INVERTED = {
    "hexahedron": [4, 5, 6, 7, 0, 1, 2, 3],
    "wedge": [3, 4, 5, 0, 1, 2],
    "tetra": [1, 0, 2, 3],
}
INVERTED["pyramid"] = [3, 2, 1, 0, 4]


def cells_of(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return points and cells of a cube of 1 m; every third cell is inverted, a point unused."""
    places: dict[tuple[float, ...], int] = {}
    cells = []
    for corner in product(range(N), repeat=3):
        cube = [tuple(2 * (c + o) for c, o in zip(corner, offset, strict=True)) for offset in CUBE]
        cube.append(tuple(2 * c + 1 for c in corner))
        cells += [[places.setdefault(cube[k], len(places)) for k in part] for part in PARTS[kind]]
    for number in range(0, len(cells), 3):
        cells[number] = [cells[number][k] for k in INVERTED[kind]]
    return np.array([*places, (9, 9, 9)]) / (2 * N), np.array(cells)


def quadratic(kind: str, points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh with a node in the middle of every edge."""
    pairs = np.sort(
        cells[:, np.array([[*map(int, edge)] for edge in KINDS[kind].edges])].reshape(-1, 2), axis=1
    )
    edges, number = np.unique(pairs, axis=0, return_inverse=True)
    middles = points[edges].mean(axis=1)
    return np.vstack([points, middles]), np.hstack(
        [cells, len(points) + number.reshape(len(cells), -1)]
    )


def write(path: Path, mesh: meshio.Mesh) -> None:
    """Write a mesh; meshio would take .msh for the format of ANSYS."""
    mesh.write(path, "gmsh" if path.suffix == ".msh" else None)


CASES = [
    *((end, kind, order) for end in ("vtu",
    "vtk") for kind in KINDS if KINDS[kind].dimension == 3 for order in (1, 2)
      if order == 1 or KINDS[kind].edges),
    *((end, kind, 1) for end in ("msh", "inp", "bdf") for kind in ("tetra", "hexahedron")),
    ("msh", "tetra", 2), ("msh", "hexahedron", 2), ("inp", "tetra", 2), ("bdf", "tetra", 2),
]  # fmt: skip


@pytest.mark.parametrize(("end", "kind", "order"), CASES)
def test_the_boundary_of_cells_encloses_their_volume(
    end: str, kind: str, order: int, tmp_path: Path
):
    points, cells = cells_of(kind)
    if order == 2:
        points, cells = quadratic(kind, points, cells)
    name = kind if order == 1 else f"{kind}{cells.shape[1]}"
    write(tmp_path / f"x.{end}", meshio.Mesh(points, [(name, cells)]))
    surface = read_surface(tmp_path / f"x.{end}")
    report = examine(surface)
    assert report.closed and report.inconsistent_edges == report.nonmanifold_edges == 0
    assert report.volume == pytest.approx(1, rel=1e-5) and report.area == pytest.approx(6, rel=1e-5)
    # unused points are dropped
    assert len(surface.points) == len(np.unique(surface.triangles))
    # wedges have triangles on some sides
    if kind != "wedge":
        cuts = {1: 2, 2: 8 if kind == "tetra" else 6}
        assert len(surface.triangles) == 6 * N**2 * cuts[order]


def test_edges_of_quadratic_cells_are_bent(tmp_path: Path):
    points, cells = quadratic("tetra", *cells_of("tetra"))
    on_top = np.isclose(points[:, 2], 1) & (np.abs(points[:, :2] - 0.25) < 0.3).all(axis=1)
    flat = on_top & ~np.isin(np.arange(len(points)), cells[:, :4])
    points[flat, 2] += 0.1
    meshio.Mesh(points, [("tetra10", cells)]).write(tmp_path / "x.vtu")
    assert examine(read_surface(tmp_path / "x.vtu")).volume > 1.001


def test_sets_of_cells_and_points_are_groups(tmp_path: Path):
    points, cells = cells_of("tetra")
    left = points[cells].mean(axis=1)[:, 0] < 0.5
    blocks = [("tetra", cells), ("triangle", np.array([[0, 1, 2], [2, 1, 3]]))]
    physical = [np.where(left, 1, 2), np.array([7, 1])]
    mesh = meshio.Mesh(
        points, blocks, cell_data={"gmsh:physical": physical, "gmsh:geometrical": physical},
        field_data={"left": np.array([1, 3]), "tip": np.array([1, 2])},
    )  # fmt: skip
    meshio.gmsh.write(tmp_path / "x.msh", mesh, "2.2", binary=False)
    groups = read_surface(tmp_path / "x.msh").groups
    assert groups.keys() == {"left", "2", "7", "tip"}
    # on their common face both groups are closed and wound outwards
    for name in ("left", "2"):
        report = examine(groups[name])
        assert report.closed and report.volume == pytest.approx(0.5)
    assert np.array_equal(groups["tip"].points[groups["tip"].triangles[0]], points[[2, 1, 3]])
    meshio.Mesh(
        points, blocks, cell_data={"region": physical, "other": [0 * each for each in physical]}
    ).write(tmp_path / "x.vtu")
    assert read_surface(tmp_path / "x.vtu").groups.keys() == {
        "region:1",
        "region:2",
        "region:7",
        "other:0",
    }
    rows = [np.flatnonzero(left), np.array([], int)]
    top = np.flatnonzero(points[:, 2] == 1)
    meshio.Mesh(points, blocks, cell_sets={"left": rows}, point_sets={"top": top}).write(
        tmp_path / "x.inp"
    )
    groups = read_surface(tmp_path / "x.inp").groups
    assert groups.keys() == {"left", "top"} and examine(groups["top"]).area == pytest.approx(1)


@pytest.mark.parametrize(
    ("end", "text", "reason"),
    [
        ("inp", "*HEADING\n*INCLUDE, INPUT=/etc/passwd\n", "includes other files"),
        ("inp", "*NODE\n1, 0, 0, 0\n*ELEMENT, TYPE=C3D4\n1, 1, 2, 3, 4\n", "not a readable INP"),
        ("bdf", "CTETRA,1,1,1,2,3,4\n", "BEGIN BULK"),
        ("bdf", "BEGIN BULK\n$ only comments\n", "it ends too early"),
        ("msh", "(0 an ANSYS mesh)\n", "not a readable MSH"),
    ],
)
def test_what_is_not_read_is_told(end: str, text: str, reason: str, tmp_path: Path):
    (tmp_path / f"x.{end}").write_text(text)
    with pytest.raises(InputError, match=reason):
        read_surface(tmp_path / f"x.{end}")
