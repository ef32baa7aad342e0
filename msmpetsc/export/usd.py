"""Write USD by its own library: a mesh for each body, with a time sample for each frame.

.usda is text, .usdc and .usd are binary. Normals are stored too, because without them programs
shade each triangle flat.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Tf, Usd, UsdGeom, Vt

from msmpetsc.backend.arrays import Array, Floats, Indices
from msmpetsc.errors import one_line
from msmpetsc.export.formats import CLAY, middle_of, normals
from msmpetsc.results.reader import Result

# USD's tokens of the axes that may be upward
UP = {1: UsdGeom.Tokens.y, 2: UsdGeom.Tokens.z}


def write_usd(run: Result, frames: Sequence[int], path: Path) -> None:
    """Write frames as USD. Raises OSError if the library cannot write them."""
    # gives a plain error if the file cannot be written; the library's has many lines
    path.touch()
    try:
        stage = Usd.Stage.CreateNew(str(path))
        root = UsdGeom.Xform.Define(stage, f"/{Tf.MakeValidIdentifier(run.path.stem)}")
        stage.SetDefaultPrim(root.GetPrim())
        UsdGeom.SetStageUpAxis(stage, up_axis(run.scene))
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        times = run.frames.time[:][frames]
        rate = frames_a_second(times)
        stage.SetTimeCodesPerSecond(rate)
        stage.SetFramesPerSecond(rate)
        codes = np.round(times * rate, 6)
        stage.SetStartTimeCode(codes[0])
        stage.SetEndTimeCode(codes[-1])
        triangles = run.indices("surface/triangles")
        of_point = run.body_of("surface")
        # Relative to the body's middle, the single precision of USD's points suffices.
        # The root node adds the middle.
        middle = middle_of(run.surface_at(frames[0]))
        root.AddTranslateOp().Set(Gf.Vec3d(*middle))
        bodies = [
            UsdBody(stage, root.GetPath(), triangles, of_point, number)
            for number in np.unique(of_point)
        ]
        # each save of a binary file writes the times of all samples again
        unsaved = math.isqrt(len(frames))
        for number, (frame, code) in enumerate(zip(frames, codes, strict=True)):
            points = run.surface_at(frame) - middle
            for body in bodies:
                body.add(points, float(code))
            # a text is written at the end
            if path.suffix != ".usda" and number % unsaved == 0:
                stage.Save()
        stage.Save()
    except Tf.ErrorException as error:
        raise OSError(one_line(error)) from error


class UsdBody:
    """The USD mesh of a body, to which frames are added."""

    def __init__(self, stage: Any, root: Any, triangles: Indices, of_point: Indices, number: int):
        """Define the constant parts: triangles and colour."""
        self._rows = np.flatnonzero(of_point == number)
        own = triangles[of_point[triangles[:, 0]] == number]
        self._triangles = np.searchsorted(self._rows, own)
        name = "body" if of_point.max() == 0 else f"body_{number}"
        self._mesh = UsdGeom.Mesh.Define(stage, root.AppendChild(name))
        # without subdivision, which would round the mesh off
        self._mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        self._mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(own), 3))
        self._mesh.CreateFaceVertexIndicesAttr(
            Vt.IntArray.FromNumpy(self._triangles.ravel().astype(np.int32))
        )
        self._mesh.CreateDisplayColorAttr([Gf.Vec3f(*CLAY)])
        self._mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)

    def add(self, points: Array, code: float) -> None:
        """Add a sample at a time code: points (v, 3) [m] of all bodies relative to the root."""
        own = points[self._rows]
        corners = np.array([own.min(axis=0), own.max(axis=0)])
        self._mesh.CreatePointsAttr().Set(_vectors(own), code)
        self._mesh.CreateNormalsAttr().Set(_vectors(normals(own, self._triangles)), code)
        self._mesh.CreateExtentAttr().Set(_vectors(corners), code)


def up_axis(scene: dict[str, Any]) -> str:
    """Return the upward axis, y or z: the axis of gravity, or z if gravity is absent or along x."""
    acceleration = np.array(scene.get("gravity", {}).get("acceleration", (0, 0, 0)), float)
    return str(UP.get(int(np.argmax(abs(acceleration))), UsdGeom.Tokens.z))


def frames_a_second(times: Floats) -> float:
    """Return the frames per second of frames at times (t,) [s], by the median of their spacing."""
    spacing = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    return float(f"{1 / spacing:.9g}")


def _vectors(rows: Array) -> Any:
    """Return rows (n, 3) as an array of USD's single-precision vectors."""
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(rows, np.float32))
