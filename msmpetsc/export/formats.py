"""The formats that a result is exported to, in one table, and the export itself."""

from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.export.moments import Mesh, Moments
from msmpetsc.results.disk import whole_file
from msmpetsc.results.frame_choice import Frames, frames_of
from msmpetsc.results.reader import Result

EXPORT = "msmpetsc.export."

CELL_TYPES = {"surface": "triangle", "lattice": "hexahedron"}
BARE = (".obj", ".ply", ".stl")  # formats of points and triangles alone


class Format(NamedTuple):
    """A format of files.

    module, writer : below this folder; the function writes moments under a path, and needs packages of its own
    moves  : whether a file holds frames in time, or one frame
    meshes : of which it can hold one; the first if none is asked for
    """

    module: str
    writer: str
    moves: bool
    meshes: tuple[Mesh, ...]


ONE_FRAME = ("formats", "write_one_frame", False)
USD = Format("usd", "write_usd", True, ("surface",))
FORMATS = {
    ".glb": Format("gltf", "write_glb", True, ("surface",)),
    ".usd": USD,
    ".usda": USD,
    ".usdc": USD,
    ".obj": Format(*ONE_FRAME, ("surface",)),
    ".ply": Format(*ONE_FRAME, ("surface",)),
    ".stl": Format(*ONE_FRAME, ("surface",)),
    ".vtu": Format(*ONE_FRAME, ("lattice", "surface")),
}


def export(result: str | Path, path: str | Path, mesh: Mesh | None = None, frames: Frames | None = None) -> Path:
    """Write frames of a result in the format that the path's ending names, and return the path.

    mesh   : "surface" or "lattice"; what the format holds, and the result has, if None
    frames : their numbers, -1 the last, or slices; all if None, or the last where the format holds one

    Raises InputError.
    """
    path = Path(path)
    chosen = FORMATS.get(path.suffix.lower())
    if chosen is None:
        raise InputError(f"{path}: what is exported is named {', '.join(f'*{ending}' for ending in FORMATS)}")
    write = getattr(import_module(EXPORT + chosen.module), chosen.writer)
    with Result(result) as run:
        moments = Moments(run, _mesh(run, path, chosen, mesh), _frames(run, path, chosen, frames))
        with whole_file(path) as part:
            write(moments, part)
    return path


def _mesh(run: Result, path: Path, chosen: Format, mesh: Mesh | None) -> Mesh:
    """Return which mesh is meant. Raises InputError for one that the format does not hold."""
    if mesh is None:
        has_surface = "surface/points" in run
        return next((m for m in chosen.meshes if m == "lattice" or has_surface), chosen.meshes[0])
    if mesh not in chosen.meshes:
        raise InputError(f"{path}: a *{path.suffix} holds no {mesh}, but the {' or the '.join(chosen.meshes)}")
    return mesh


def _frames(run: Result, path: Path, chosen: Format, frames: Frames | None) -> list[int]:
    """Return the numbers of the frames meant. Raises InputError for frames that the result does not have."""
    count = len(run.frames.time)
    if not count:
        raise InputError(f"{run.path} has no finished frame")
    if frames is None:
        frames = [slice(None) if chosen.moves else -1]
    numbers = frames_of(str(run.path), frames, count)
    if not chosen.moves and len(numbers) > 1:
        raise InputError(f"{path}: a *{path.suffix} holds one frame, not {len(numbers)}")
    if np.any(np.diff(numbers) <= 0):
        raise InputError("frames to be exported must follow each other in time, each once")
    return numbers


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
