"""Binary glTF 2.0: the surface moves by morph targets, one a frame, as Blender and browsers play it.

A small writer of our own: libraries that read glTF write neither morph targets nor their animation. The file is a JSON
chunk and one binary chunk (the glTF 2.0 specification, 4.4); it has y up, so the node is turned.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.export.moments import Moments, normals

FLOAT, UNSIGNED = 5126, 5125  # component types
POINTS, TRIANGLES = 34962, 34963  # uses of a buffer view: vertex data, indices
MOST_BYTES = 2**32 - 1
Z_UP_TO_Y_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # a quarter turn about x
CLAY = {"pbrMetallicRoughness": {"baseColorFactor": [0.8, 0.55, 0.4, 1.0], "metallicFactor": 0.0}, "doubleSided": True}


class Chunk:
    """The binary chunk's table of contents, filled before the numbers are written one after another.

    accessors, views : as the JSON chunk lists them
    size             : of all so far [byte], a multiple of four
    """

    def __init__(self) -> None:
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self.size = 0

    def add(self, count: int, kind: str, bounds: np.ndarray | None = None, use: int | None = None) -> int:
        """Make room for so many SCALAR or VEC3, all of four bytes; return the accessor's number.

        bounds : (2, 1) or (2, 3) least and greatest values, which points, targets and times must say
        """
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self.size}
        view["byteLength"] = count * 4 * (3 if kind == "VEC3" else 1)
        component = UNSIGNED if use == TRIANGLES else FLOAT
        accessor: dict[str, Any] = {"bufferView": len(self.views), "componentType": component, "count": count}
        accessor["type"] = kind
        if bounds is not None:
            accessor |= {"min": bounds[0].tolist(), "max": bounds[1].tolist()}
        self.views.append(view | ({"target": use} if use else {}))
        self.accessors.append(accessor)
        self.size += view["byteLength"]
        return len(self.accessors) - 1


def write_glb(moments: Moments, path: Path) -> None:
    """Write the frames; every frame is read twice, for the file begins with the bounds of all.

    Raises InputError where the file would be longer than its format allows.
    """
    first, *others = moments.frames
    base = moments.points(first).astype(np.float32)
    chunk = Chunk()
    indices = chunk.add(moments.cells.size, "SCALAR", use=TRIANGLES)
    shape = _vectors(chunk, base)
    targets = [_vectors(chunk, _target(moments, frame, base)[0]) for frame in others]
    document = _document(shape, indices, targets, moments.run.path.stem)
    if others:
        times = (moments.times - moments.times[0]).astype(np.float32)
        _animate(document, chunk, times, len(others))
    document |= {"accessors": chunk.accessors, "bufferViews": chunk.views, "buffers": [{"byteLength": chunk.size}]}
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + chunk.size
    if total > MOST_BYTES:
        raise InputError(
            f"{path} would have {total / 2**30:.3g} GiB, and glTF ends at 4: choose fewer frames (--frames)"
        )
    with open(path, "wb") as file:
        file.write(struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", chunk.size, b"BIN\0"))
        file.write(moments.cells.astype("<u4").tobytes())
        file.write(base.tobytes() + normals(base, moments.cells).tobytes())
        for frame in others:
            moved, turned = _target(moments, frame, base)
            file.write(moved.tobytes() + turned.tobytes())
        if others:
            file.write(times.tobytes() + np.eye(len(others) + 1, len(others), -1, np.float32).tobytes())


def _target(moments: Moments, frame: int, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far a frame's points and normals are from the first's, (v, 3) float32 each."""
    points = moments.points(frame).astype(np.float32)
    return points - base, normals(points, moments.cells) - normals(base, moments.cells)


def _vectors(chunk: Chunk, points: np.ndarray) -> dict[str, int]:
    """Make room for points, of which the file says the bounds, and their normals."""
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    return {
        "POSITION": chunk.add(len(points), "VEC3", bounds, POINTS),
        "NORMAL": chunk.add(len(points), "VEC3", use=POINTS),
    }


def _document(shape: dict[str, int], indices: int, targets: list[dict[str, int]], name: str) -> dict[str, Any]:
    """Return the JSON chunk's scene: one node, one mesh."""
    primitive: dict[str, Any] = {"attributes": shape, "indices": indices, "material": 0}
    mesh: dict[str, Any] = {"primitives": [primitive], "name": name}
    if targets:
        primitive["targets"] = targets
        mesh["weights"] = [0.0] * len(targets)
    return {
        "asset": {"version": "2.0", "generator": "msmpetsc"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": Z_UP_TO_Y_UP, "name": name}],
        "meshes": [mesh],
        "materials": [CLAY],
    }


def _animate(document: dict[str, Any], chunk: Chunk, times: np.ndarray, targets: int) -> None:
    """Let each target have its frame's time alone, in straight lines from one to the next."""
    bounds = np.array([times[:1], times[-1:]])
    sampler = {"input": chunk.add(len(times), "SCALAR", bounds), "output": chunk.add(len(times) * targets, "SCALAR")}
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    document["animations"] = [{"samplers": [sampler | {"interpolation": "LINEAR"}], "channels": [channel]}]
