"""One frame in a mesh format, written by meshio: OBJ, PLY and STL of the surface, VTU of either."""

from pathlib import Path

import meshio

from msmpetsc.output.export.moments import Moments

CELL_TYPES = {"surface": "triangle", "lattice": "hexahedron"}
BARE = (".obj", ".ply", ".stl")  # formats of points and triangles alone


def write_one_frame(moments: Moments, path: Path) -> None:
    """Write the one frame, with its data where the format has them."""
    (frame,) = moments.frames
    cells = [(CELL_TYPES[moments.mesh], moments.cells)]
    of_points = moments.data_of_points(frame) | moments.constant_data_of_points()
    of_cells = moments.data_of_cells(frame) | moments.constant_data_of_cells()
    if path.suffix.lower() in BARE:
        of_points, of_cells = {}, {}
    in_blocks = {name: [values] for name, values in of_cells.items()}
    meshio.write(path, meshio.Mesh(moments.points(frame), cells, of_points, in_blocks))
