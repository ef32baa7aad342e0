"""A surface to draw whose nodes are its points, for tests of drawing without a result."""

import tomllib

import numpy as np
from ball_result import BARE
from scipy.sparse import csr_array, eye_array

from msmpetsc.scene.schema import SceneFile
from msmpetsc.view.drawable import BodiesAtRest, Drawable


def drawable_of(points: np.ndarray, triangles: np.ndarray) -> Drawable:
    """Return the drawable surface at rest; its cell is so large that no triangle is divided."""
    ends = [*points.argmin(axis=0), *points.argmax(axis=0)]
    body = np.zeros(len(points), int)
    return Drawable(
        name="x.h5",
        scene=SceneFile.model_validate(tomllib.loads(BARE)),
        rest=BodiesAtRest(points, np.array([[*ends, 0, 0]]), points, body, body),
        pinned=np.zeros(len(points), bool),
        triangles=triangles,
        times=np.zeros(1),
        nodes=lambda _: points,
        embedding=csr_array(eye_array(len(points))),
        array={}.__getitem__,
        solids={},
    )
