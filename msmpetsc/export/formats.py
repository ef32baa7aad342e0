"""The formats that a result is exported to, in one table, and the export itself."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.export.gltf import write_glb
from msmpetsc.export.moments import Mesh, Moments
from msmpetsc.results.disk import whole_file
from msmpetsc.results.frame_choice import Frames, frames_of
from msmpetsc.results.reader import Result

CELL_TYPES = {"surface": "triangle", "lattice": "hexahedron"}
BARE = (".obj", ".ply", ".stl")  # formats of points and triangles alone


def write_usd(moments: Moments, path: Path) -> None:
    """Write the frames as USD, by a library that only this format needs."""
    from msmpetsc.export import usd

    usd.write_usd(moments, path)


def write_one_frame(moments: Moments, path: Path) -> None:
    """Write the one frame by meshio, with its data where the format has them."""
    import meshio

    (frame,) = moments.frames
    cells = [(CELL_TYPES[moments.mesh], moments.cells)]
    of_points, of_cells = moments.data_of_points(frame), moments.data_of_cells(frame)
    if path.suffix.lower() in BARE:
        of_points, of_cells = {}, {}
    in_blocks = {name: [values] for name, values in of_cells.items()}
    meshio.write(path, meshio.Mesh(moments.points(frame), cells, of_points, in_blocks))


FORMATS: dict[str, Callable[[Moments, Path], None]] = {
    ".glb": write_glb,
    ".usd": write_usd,
    ".usda": write_usd,
    ".usdc": write_usd,
    ".obj": write_one_frame,
    ".ply": write_one_frame,
    ".stl": write_one_frame,
    ".vtu": write_one_frame,
}
MESHES: dict[str, tuple[Mesh, ...]] = {".vtu": ("lattice", "surface")}  # of which a file holds one; else surfaces


def export(result: str | Path, path: str | Path, mesh: Mesh | None = None, frames: Frames | None = None) -> Path:
    """Write frames of a result in the format that the path's ending names, and return the path.

    mesh   : "surface" or "lattice"; what the format holds, and the result has, if None
    frames : their numbers, -1 the last, or slices; all if None, or the last where the format holds one

    Raises InputError.
    """
    path = Path(path)
    write = FORMATS.get(path.suffix.lower())
    if write is None:
        raise InputError(f"{path}: what is exported is named {', '.join(f'*{ending}' for ending in FORMATS)}")
    with Result(result) as run:
        numbers = _frames(run, path, write is not write_one_frame, frames)
        moments = Moments(run, _mesh(run, path, mesh), numbers)
        with whole_file(path) as part:
            write(moments, part)
    return path


def _mesh(run: Result, path: Path, mesh: Mesh | None) -> Mesh:
    """Return which mesh is meant. Raises InputError for one that the format does not hold."""
    meshes = MESHES.get(path.suffix.lower(), ("surface",))
    if mesh is None:
        has_surface = "surface/points" in run
        return next((m for m in meshes if m == "lattice" or has_surface), meshes[0])
    if mesh not in meshes:
        raise InputError(f"{path}: a *{path.suffix} holds no {mesh}, but the {' or the '.join(meshes)}")
    return mesh


def _frames(run: Result, path: Path, moves: bool, frames: Frames | None) -> list[int]:
    """Return the numbers of the frames meant. Raises InputError for frames that the result does not have."""
    count = len(run.frames.time)
    if not count:
        raise InputError(f"{run.path} has no finished frame")
    if frames is None:
        frames = [slice(None) if moves else -1]
    numbers = frames_of(str(run.path), frames, count)
    if not moves and len(numbers) > 1:
        raise InputError(f"{path}: a *{path.suffix} holds one frame, not {len(numbers)}")
    if np.any(np.diff(numbers) <= 0):
        raise InputError("frames to be exported must follow each other in time, each once")
    return numbers
