"""The exported frames of a result, independent of the format, one frame in memory at a time."""

from collections.abc import Sequence

import numpy as np

from msmpetsc.backend.arrays import Array, Indices
from msmpetsc.errors import InputError
from msmpetsc.results.reader import Result


class Moments:
    """Frames of the surface's triangles.

    frames : numbers of those chosen
    times  : (t,) [s]
    cells  : (f, 3) corner points
    """

    def __init__(self, run: Result, frames: Sequence[int]):
        """Choose frames. Raises InputError for a result without a surface, or a damaged one."""
        self.run, self.frames = run, list(frames)
        if "surface/points" not in run:
            raise InputError(f"{run.path} has no surface: it was run with output.surface = false")
        self.times, self.cells = run.frames.time[:][self.frames], run.indices("surface/triangles")


def normals(points: Array, triangles: Indices) -> Array:
    """Return area-weighted unit normals (v, 3) float32 at points (v, 3) of triangles (f, 3)."""
    corners = points[triangles].astype(float)
    of_faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = [np.bincount(triangles.ravel(), np.repeat(along, 3), len(points)) for along in of_faces.T]
    vectors = np.stack(sums, axis=1)
    vectors[~vectors.any(axis=1)] = (0, 0, 1)  # a point of no triangle, or of folded ones: any direction is as good
    return np.divide(vectors, np.linalg.norm(vectors, axis=1, keepdims=True), dtype=np.float32)
