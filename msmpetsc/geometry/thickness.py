"""Thickness of a body, and how much its thin walls bend on cells, over theory.

The thickness at a point of the surface is the length of the ray inwards along the normal. It is
exact for a slab and a ball. The diameter of the largest ball inside would vanish at every edge of a
box.

Points are spread evenly over the area, because walls that bend have much area for their volume.
Weights by volume would count the few rays along a wall as much as all rays across it.

A wall along the grid bends freely on trilinear cells. Let a wall of thickness d have a normal at an
angle theta to the nearest axis. Then its bending stiffness is too large by the fraction
EXCESS (h sin(2 theta) / d)^2. With springs the fraction is EXCESS (h / d)^2 at any angle.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import trimesh

from msmpetsc.geometry.surface import Surface, SurfaceReport, bounds_of
from msmpetsc.scene.body import SOLID

# number of rays [-]; it gives the thinnest tenth of the area to a hundredth
RAYS = 4000
# longest side to which a body is scaled for rays [-]; libigl overlooks triangles of an
# area below 1e-6
SIDE = 1e6
# start of a ray inside the surface [longest side]; above rounding, below all details
START = 1e-9
# excess of bending stiffness at d = h and 45 degrees [-]; 1.2 to 1.4 are measured
EXCESS = 1.25
# share of theory below which bending is too little [-]; a wall of three cells has 0.9
ENOUGH = 0.9
# share of theory that the advised cells have [-]; rounding leaves it above ENOUGH
ADVISED = 0.91


@dataclass(frozen=True)
class Thickness:
    """Thickness of a body.

    median : thickness below which half of the surface is [m]
    thin   : thickness below which a tenth of the surface is [m], the "thin tenth"
    askew  : like ``thin``, for the thickness over sin(2 theta) [m]; huge for walls along the grid
    """

    median: float
    thin: float
    askew: float

    def bending(self, cell_size: float, law: str) -> float:
        """Estimate how much the thin tenth bends on cells of side h [m], over theory [-]."""
        return float(1 / (1 + EXCESS * (cell_size / self._thin(law)) ** 2))

    def advised_size(self, law: str) -> float:
        """Return the cell size [m] on which the thin tenth bends by ADVISED of theory."""
        return float(self._thin(law) * np.sqrt((1 / ADVISED - 1) / EXCESS))

    def cells(self, cell_size: float) -> dict[str, float]:
        """Return the thicknesses "median" and "thin" in cells of side h [m]."""
        return {"median": self.median / cell_size, "thin": self.thin / cell_size}

    def _thin(self, law: str) -> float:
        return self.askew if law == SOLID else self.thin


def thickness_words(cells: Mapping[str, float]) -> str:
    """Return a phrase on a thickness in cells."""
    return f"{cells['median']:.3g} cells thick, {cells['thin']:.3g} at its thin tenth"


def thickness_of(surface: Surface, report: SurfaceReport) -> Thickness | None:
    """Return the thickness of a closed body, by rays from fixed random points of its surface.

    Return None for an open surface, or if no ray meets the other side.
    """
    import igl

    if not report.closed:
        return None
    low, high = bounds_of(surface)
    scale = SIDE / (high - low).max()
    mesh = trimesh.Trimesh(
        scale * (surface.points - (low + high) / 2), surface.triangles, process=False
    )
    points, faces = trimesh.sample.sample_surface(mesh, RAYS, seed=0)
    inwards = -np.copysign(1.0, report.volume) * mesh.face_normals[faces]
    corners, triangles = np.array(mesh.vertices), np.array(mesh.faces, np.int64)
    tree = igl.AABB()
    tree.init(corners, triangles)
    starts = points + START * SIDE * inwards
    met, length, _ = tree.intersect_ray_first(corners, triangles, starts, inwards)
    met = met >= 0
    if not met.any():
        return None
    length = (length[met] + START * SIDE) / scale
    along = (inwards[met] ** 2).max(axis=1)
    # the sine is at least 3e-8, also for walls along the grid
    sine = 2 * np.sqrt(along * np.maximum(1 - along, np.finfo(float).eps))
    thin, median = np.quantile(length, [0.1, 0.5])
    return Thickness(float(median), float(thin), float(np.quantile(length / sine, 0.1)))
