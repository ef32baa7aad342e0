"""The formats of exported results in one table, and the export itself.

glTF is written by a small writer of our own: libraries that read glTF write neither morph targets nor their animation.
The surface moves by morph targets, one a frame, as Blender and browsers play it. The file is a JSON chunk and one
binary chunk (the glTF 2.0 specification, 4.4); it has y up, so the node is turned.
"""

import json
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions
from msmpetsc.errors import InputError
from msmpetsc.results.disk import whole_file
from msmpetsc.results.frame_choice import Frames, frames_of
from msmpetsc.results.reader import Result

FLOAT, UNSIGNED = 5126, 5125  # component types
POINTS, TRIANGLES = 34962, 34963  # uses of a buffer view: vertex data, indices
MOST_BYTES = 2**32 - 2**20  # less what is no vertex
Z_UP_TO_Y_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # a quarter turn about x
CLAY = {
    "pbrMetallicRoughness": {"baseColorFactor": [0.8, 0.55, 0.4, 1.0], "metallicFactor": 0.0},
    "doubleSided": True,
}


def normals(points: Array, triangles: Indices) -> Array:
    """Return area-weighted unit normals (v, 3) float32 at points (v, 3) of triangles (f, 3)."""
    corners = points[triangles].astype(float)
    of_faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = [
        np.bincount(triangles.ravel(), np.repeat(along, 3), len(points)) for along in of_faces.T
    ]
    vectors = np.stack(sums, axis=1)
    vectors[~vectors.any(axis=1)] = (
        0,
        0,
        1,
    )  # a point of no triangle, or of folded ones: any direction is as good
    return np.divide(vectors, np.linalg.norm(vectors, axis=1, keepdims=True), dtype=np.float32)


def middle_of(points: Positions) -> Floats:
    """Return the middle (3,) [m] of the box around points (n, 3)."""
    middle: Floats = (points.min(axis=0) + points.max(axis=0)) / 2
    return middle


class Chunk:
    """The binary chunk of a glTF file, to which numbers of four bytes are added.

    accessors, views : as the JSON chunk lists them
    parts, size      : its bytes so far, and how many
    """

    def __init__(self) -> None:
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self.parts: list[bytes] = []
        self.size = 0

    def add(self, rows: Array, use: int | None = None, bounds: bool = False) -> int:
        """Add numbers (n,) or vectors (n, 3), float32 or uint32; return the accessor's number.

        bounds : whether to say the least and greatest values, as points, targets and times must
        """
        component = UNSIGNED if use == TRIANGLES else FLOAT
        accessor: dict[str, Any] = {
            "bufferView": len(self.views),
            "componentType": component,
            "count": len(rows),
        }
        accessor["type"] = "VEC3" if rows.ndim == 2 else "SCALAR"
        if bounds:
            ends = np.reshape([rows.min(axis=0), rows.max(axis=0)], (2, -1)).tolist()
            accessor |= {"min": ends[0], "max": ends[1]}
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": rows.nbytes}
        self.views.append(view | ({"target": use} if use else {}))
        self.accessors.append(accessor)
        self.parts.append(rows.tobytes())
        self.size += rows.nbytes
        return len(self.accessors) - 1

    def add_shape(self, points: Array, normals: Array) -> dict[str, int]:
        """Add points and normals, (v, 3) float32 each; return their accessors."""
        return {
            "POSITION": self.add(points, POINTS, bounds=True),
            "NORMAL": self.add(normals, POINTS),
        }


def write_glb(run: Result, frames: Sequence[int], path: Path) -> None:
    """Write frames as glTF. Raises InputError for more bytes than the format allows."""
    first, *others = frames
    triangles = run.indices("surface/triangles")
    start = run.surface_at(first)
    # single precision is exact about the body's middle, where the node puts the points
    middle = middle_of(start)
    base = (start - middle).astype(np.float32)
    upright = normals(base, triangles)
    chunk = Chunk()
    indices = chunk.add(triangles.astype("<u4").ravel(), TRIANGLES)
    shape = chunk.add_shape(base, upright)
    targets = []
    for frame in others:
        points = (run.surface_at(frame) - middle).astype(np.float32)
        targets.append(chunk.add_shape(points - base, normals(points, triangles) - upright))
        if chunk.size > MOST_BYTES:
            raise InputError(
                f"{path} would be longer than 4 GiB, where glTF ends: choose fewer frames (--frames)"
            )
    document = _document(shape, indices, targets, run.path.stem, middle)
    if others:
        document["animations"] = [_animation(chunk, run.frames.time[:][frames], len(others))]
    document |= {
        "accessors": chunk.accessors,
        "bufferViews": chunk.views,
        "buffers": [{"byteLength": chunk.size}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    with open(path, "wb") as file:
        file.write(
            struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + chunk.size, len(text), b"JSON")
            + text
        )
        file.write(struct.pack("<I4s", chunk.size, b"BIN\0"))
        file.writelines(chunk.parts)


def _document(
    shape: dict[str, int], indices: int, targets: list[dict[str, int]], name: str, middle: Floats
) -> dict[str, Any]:
    """Return the scene of glTF's JSON chunk: one node at ``middle`` (3,) [m], z up, with one mesh."""
    x, y, z = middle.tolist()
    primitive: dict[str, Any] = {"attributes": shape, "indices": indices, "material": 0}
    mesh: dict[str, Any] = {"primitives": [primitive], "name": name}
    if targets:
        primitive["targets"] = targets
        mesh["weights"] = [0.0] * len(targets)
    return {
        "asset": {"version": "2.0", "generator": "msmpetsc"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [x, z, -y], "rotation": Z_UP_TO_Y_UP, "name": name}],
        "meshes": [mesh],
        "materials": [CLAY],
    }


def _animation(chunk: Chunk, times: Floats, targets: int) -> dict[str, Any]:
    """Return the animation that blends linearly between morph targets at the frames' times (t,) [s]."""
    since = (times - times[0]).astype(np.float32)
    weights = np.eye(targets + 1, targets, -1, np.float32).ravel()
    sampler = {
        "input": chunk.add(since, bounds=True),
        "output": chunk.add(weights),
        "interpolation": "LINEAR",
    }
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    return {"samplers": [sampler], "channels": [channel]}


def write_usd(run: Result, frames: Sequence[int], path: Path) -> None:
    """Write frames as USD, by a library that only this format needs."""
    from msmpetsc.export import usd

    usd.write_usd(run, frames, path)


def write_one_frame(run: Result, frames: Sequence[int], path: Path) -> None:
    """Write a single frame by meshio."""
    import meshio

    (frame,) = frames
    meshio.write(
        path, meshio.Mesh(run.surface_at(frame), [("triangle", run.indices("surface/triangles"))])
    )


FORMATS: dict[str, Callable[[Result, Sequence[int], Path], None]] = {  # of the surface at frames
    ".glb": write_glb,
    ".usd": write_usd,
    ".usda": write_usd,
    ".usdc": write_usd,
    ".obj": write_one_frame,
    ".ply": write_one_frame,
    ".stl": write_one_frame,
}


def export(result: str | Path, path: str | Path, frames: Frames | None = None) -> Path:
    """Write the surface at frames of a result in the format that the path ends in; return it.

    frames : their numbers, -1 the last, or slices; all if None, or the last where the format holds one

    Raises InputError.
    """
    path = Path(path)
    write = FORMATS.get(path.suffix.lower())
    if write is None:
        raise InputError(
            f"{path}: what is exported is named {', '.join(f'*{ending}' for ending in FORMATS)}"
        )
    with Result(result) as run:
        numbers = _frames(run, path, write is not write_one_frame, frames)
        if "surface/points" not in run:
            raise InputError(f"{run.path} has no surface: it was run with output.surface = false")
        with whole_file(path) as part:
            write(run, numbers, part)
    return path


def _frames(run: Result, path: Path, moves: bool, frames: Frames | None) -> list[int]:
    """Return the numbers of the frames to export. Raises InputError for those there are not."""
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
