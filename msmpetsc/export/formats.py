"""Export results: a table of the formats, and the writers of glTF and meshio's formats.

glTF is written here, because libraries for glTF write no animated morph targets. Each frame after
the first is a morph target of the surface, which Blender and browsers play. The file has a JSON
chunk and a binary chunk (glTF 2.0 specification, 4.4). In glTF y is up, so the node is rotated.
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

# component types of glTF
FLOAT, UNSIGNED = 5126, 5125
# targets of a glTF buffer view: vertex attributes, indices
POINTS, TRIANGLES = 34962, 34963
# size of the binary chunk [byte]; a file of 4 GiB, with room for the JSON chunk
MOST_BYTES = 2**32 - 2**20
# rotation by a quarter turn about x, as a quaternion (x, y, z, w)
Z_UP_TO_Y_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
CLAY = [0.8, 0.55, 0.4]


def normals(points: Array, triangles: Indices) -> Array:
    """Return area-weighted unit normals (v, 3) float32 at points (v, 3) of triangles (f, 3)."""
    corners = points[triangles].astype(float)
    of_faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = [
        np.bincount(triangles.ravel(), np.repeat(along, 3), len(points)) for along in of_faces.T
    ]
    vectors = np.stack(sums, axis=1)
    # a point without triangles, or with folded triangles, may have any normal
    vectors[~vectors.any(axis=1)] = (0, 0, 1)
    return np.divide(vectors, np.linalg.norm(vectors, axis=1, keepdims=True), dtype=np.float32)


def middle_of(points: Positions) -> Floats:
    """Return the middle (3,) [m] of the bounding box of points (n, 3)."""
    middle: Floats = (points.min(axis=0) + points.max(axis=0)) / 2
    return middle


class Chunk:
    """The binary chunk of a glTF file, made of arrays of four-byte numbers.

    accessors, views : entries of the JSON chunk
    parts, size      : contents so far, and their length [byte]
    """

    def __init__(self) -> None:
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self.parts: list[bytes] = []
        self.size = 0

    def add(self, rows: Array, use: int | None = None) -> int:
        """Add numbers (n,) or vectors (n, 3), float32 or uint32; return the accessor's index.

        use : target of the buffer view, POINTS or TRIANGLES
        """
        ends = np.reshape([rows.min(axis=0), rows.max(axis=0)], (2, -1)).tolist()
        accessor = {
            "bufferView": len(self.views),
            "componentType": UNSIGNED if use == TRIANGLES else FLOAT,
            "count": len(rows),
            "type": "VEC3" if rows.ndim == 2 else "SCALAR",
            "min": ends[0],
            "max": ends[1],
        }
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": rows.nbytes}
        self.views.append(view | ({"target": use} if use else {}))
        self.accessors.append(accessor)
        self.parts.append(rows.tobytes())
        self.size += rows.nbytes
        return len(self.accessors) - 1

    def add_shape(self, points: Array, normals: Array) -> dict[str, int]:
        """Add points and normals, (v, 3) float32 each; return their accessors."""
        return {"POSITION": self.add(points, POINTS), "NORMAL": self.add(normals, POINTS)}


def write_glb(run: Result, frames: Sequence[int], path: Path) -> None:
    """Write frames as glTF. Raises InputError if the file would exceed the format's limit."""
    first, *others = frames
    triangles = run.indices("surface/triangles")
    start = run.surface_at(first)
    # single precision suffices relative to the body's middle, which the node adds
    middle = middle_of(start)
    base = (start - middle).astype(np.float32)
    upright = normals(base, triangles)
    chunk = Chunk()
    indices = chunk.add(triangles.astype("<u4").ravel(), TRIANGLES)
    shape = chunk.add_shape(base, upright)
    targets = []
    # the animation has a weight of each target at each frame
    weights = 4 * len(frames) * len(others)
    for frame in others:
        points = (run.surface_at(frame) - middle).astype(np.float32)
        targets.append(chunk.add_shape(points - base, normals(points, triangles) - upright))
        if chunk.size + weights > MOST_BYTES:
            raise InputError(
                f"{path} would be longer than 4 GiB, the limit of glTF: "
                "choose fewer frames (--frames)"
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
    """Return the scene of the JSON chunk: a node at ``middle`` (3,) [m], z up, with a mesh."""
    x, y, z = middle.tolist()
    primitive: dict[str, Any] = {"attributes": shape, "indices": indices, "material": 0}
    mesh: dict[str, Any] = {"primitives": [primitive], "name": name}
    colour = {"baseColorFactor": [*CLAY, 1.0], "metallicFactor": 0.0}
    if targets:
        primitive["targets"] = targets
        mesh["weights"] = [0.0] * len(targets)
    return {
        "asset": {"version": "2.0", "generator": "msmpetsc"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [x, z, -y], "rotation": Z_UP_TO_Y_UP, "name": name}],
        "meshes": [mesh],
        "materials": [{"pbrMetallicRoughness": colour, "doubleSided": True}],
    }


def _animation(chunk: Chunk, times: Floats, targets: int) -> dict[str, Any]:
    """Return the animation that shows each frame at its time (t,) [s], linear between frames."""
    since = (times - times[0]).astype(np.float32)
    weights = np.eye(targets + 1, targets, -1, np.float32).ravel()
    ends = {"input": chunk.add(since), "output": chunk.add(weights)}
    sampler = ends | {"interpolation": "LINEAR"}
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    return {"samplers": [sampler], "channels": [channel]}


def write_usd(run: Result, frames: Sequence[int], path: Path) -> None:
    """Write frames as USD, by a library that no other format needs."""
    from msmpetsc.export import usd

    usd.write_usd(run, frames, path)


def write_one_frame(run: Result, frames: Sequence[int], path: Path) -> None:
    """Write a single frame by meshio."""
    import meshio

    (frame,) = frames
    # PLY has no wider integers
    triangles = run.indices("surface/triangles").astype(np.int32)
    meshio.write(path, meshio.Mesh(run.surface_at(frame), [("triangle", triangles)]))


# writers of the surface at frames, by the ending of the file
FORMATS: dict[str, Callable[[Result, Sequence[int], Path], None]] = {
    ".glb": write_glb,
    ".usd": write_usd,
    ".usda": write_usd,
    ".usdc": write_usd,
    ".obj": write_one_frame,
    ".ply": write_one_frame,
    ".stl": write_one_frame,
}


def export(result: str | Path, path: str | Path, frames: Frames | None = None) -> Path:
    """Write the surface at frames of a result, in the format of the path's ending; return the path.

    frames : frame numbers, -1 for the last, or slices; by default all frames, or the last frame if
             the format holds a single frame

    Raises InputError if the format, the frames or the file is invalid.
    """
    path = Path(path)
    write = FORMATS.get(path.suffix.lower())
    if write is None:
        raise InputError(
            f"{path}: unknown format: name the file {', '.join(f'*{ending}' for ending in FORMATS)}"
        )
    with Result(result) as run:
        numbers = _frames(run, path, write is not write_one_frame, frames)
        if "surface/points" not in run:
            raise InputError(f"{run.path} has no surface: it was run with output.surface = false")
        with whole_file(path) as part:
            write(run, numbers, part)
    return path


def _frames(run: Result, path: Path, moves: bool, frames: Frames | None) -> list[int]:
    """Return the numbers of the frames to export. Raises InputError for missing frames."""
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
