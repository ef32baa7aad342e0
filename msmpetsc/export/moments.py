"""The exported frames of a result, independent of the format, one frame in memory at a time."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from msmpetsc.backend.arrays import Array, Indices
from msmpetsc.errors import InputError
from msmpetsc.fields import FRAME_FIELDS, LATTICE, STRESS
from msmpetsc.results.reader import Result

Mesh = Literal["surface", "lattice"]


class Moments:
    """Frames of the surface's triangles or of the lattice's cells.

    frames : numbers of those chosen
    times  : (t,) [s]
    rest   : (n, 3) points at rest [m]
    cells  : (c, 3) or (c, 8) corner points, in VTK's order
    """

    def __init__(self, run: Result, mesh: Mesh, frames: Sequence[int]):
        """Choose frames. Raises InputError for a result without the surface asked for, or a damaged one."""
        self.run, self.mesh, self.frames = run, mesh, list(frames)
        if mesh == "surface" and "surface/points" not in run:
            raise InputError(f"{run.path} has no surface: it was run with output.surface = false")
        self.times = run.frames.time[:][self.frames]
        names = ("surface/points", "surface/triangles") if mesh == "surface" else ("lattice/nodes", "lattice/cells")
        self.rest, self.cells = run[names[0]][:], run.indices(names[1])

    def points(self, frame: int) -> Array:
        """Return the points of a frame, (n, 3) [m]."""
        return self.run.frames.position[frame] if self.mesh == "lattice" else self.run.surface_at(frame)

    def data_of_points(self, frame: int) -> dict[str, Array]:
        """Return the data at the points: displacement, velocity, stored stress; of the lattice mass and pins.

        displacement : from rest, (n, 3) [m]
        velocity     : the mean since the frame before, (n, 3) [m/s]; 0 at the first
        """
        points = self.points(frame)
        velocity = np.zeros_like(points)
        if frame > 0:
            before, now = self.run.frames.time[frame - 1 : frame + 1]
            velocity = (points - self.points(frame - 1)) / (now - before)
        data = {"displacement": (points - self.rest).astype(points.dtype), "velocity": velocity.astype(points.dtype)}
        stress = self._stress("n", frame)
        if self.mesh == "surface":
            W = self.run.embedding if stress else None
            return data | ({} if W is None else {name: W @ rows for name, rows in stress.items()})
        pinned = np.zeros(len(self.rest), np.uint8)
        if "pinned" in self.run.lattice:
            pinned[self.run.lattice.pinned[:]] = 1
        return data | {"pinned": pinned} | self._constant("n", "nodes") | stress

    def data_of_cells(self, frame: int) -> dict[str, Array]:
        """Return the lattice's data by cell; none for the surface."""
        return {} if self.mesh == "surface" else self._constant("c", "cells") | self._stress("c", frame)

    def _stress(self, letter: str, frame: int) -> dict[str, Array]:
        arrays = self.run.frames
        return {name: arrays[name][frame] for name in STRESS if name in arrays and letter in FRAME_FIELDS[name].shape}

    def _constant(self, letter: str, points: str) -> dict[str, Array]:
        arrays = self.run.lattice
        return {name: arrays[name][:] for name in arrays if name != points and LATTICE[name].shape == (letter,)}


def normals(points: Array, triangles: Indices) -> Array:
    """Return area-weighted unit normals (v, 3) float32 at points (v, 3) of triangles (f, 3)."""
    corners = points[triangles].astype(float)
    of_faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = [np.bincount(triangles.ravel(), np.repeat(along, 3), len(points)) for along in of_faces.T]
    vectors = np.stack(sums, axis=1)
    vectors[~vectors.any(axis=1)] = (0, 0, 1)  # a point of no triangle, or of folded ones: any direction is as good
    return np.divide(vectors, np.linalg.norm(vectors, axis=1, keepdims=True), dtype=np.float32)
