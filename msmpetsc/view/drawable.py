"""Bodies to be drawn: from a result's frames, or from a scene before its first step."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from msmpetsc.backend.arrays import Array, Floats, Indices, Mask, Positions
from msmpetsc.constraints.time_functions import within
from msmpetsc.errors import InputError
from msmpetsc.geometry.inside import inside_bodies
from msmpetsc.geometry.surface import Surface, compact
from msmpetsc.results.reader import Result
from msmpetsc.scene.schema import OfBody, SceneFile

# largest coordinate that can be drawn [m]; VTK squares coordinates in single precision
FARTHEST = 1e15


@dataclass(frozen=True)
class BodiesAtRest:
    """Bodies at rest: nodes (n, 3) [m], cells (c, 8) and surface points (v, 3) [m].

    body_of_node, body_of_point : body numbers (n,), (v,)
    """

    nodes: Positions
    cells: Indices
    points: Positions
    body_of_node: Indices
    body_of_point: Indices

    @property
    def bounds(self) -> Positions:
        """Corners (b, 2, 3) of the bounding box of each body's surface [m]."""
        of_bodies = (
            self.points[self.body_of_point == number]
            for number in range(self.body_of_point.max() + 1)
        )
        return np.array([(points.min(axis=0), points.max(axis=0)) for points in of_bodies])

    def find(self, table: OfBody) -> Mask:
        """Return the mask (n,) of nodes in a table's region; empty if the result lacks it."""
        region = table.table.region
        if region.is_of_mesh:
            return np.isin(np.arange(len(self.nodes)), self.cells[self._painted_cells(table)])
        # the nearest point of the body's box stands for a node outside the box
        low, high = np.moveaxis(self.bounds[self.body_of_node], 1, 0)
        return inside_bodies(
            region, np.clip(self.nodes, low, high), self.bounds, self.body_of_node, table.body
        )

    @property
    def middles(self) -> Positions:
        """Centres (c, 3) of the cells [m]."""
        return np.asarray(self.nodes[self.cells].mean(axis=1))

    def points_in(self, table: OfBody) -> Mask:
        """Return the mask (v,) of points in a table's region; empty if the result lacks it."""
        region = table.table.region
        if region.is_of_mesh:
            around = self.cells_around(self.points, self.body_of_point)
            return np.isin(around, self._painted_cells(table))
        return inside_bodies(region, self.points, self.bounds, self.body_of_point, table.body)

    def _painted_cells(self, table: OfBody) -> Indices:
        """Return the numbers of the cells that contain the painted points of a table's region."""
        painted = table.table.region.painted
        number = table.body or 0
        # a result does not contain the points of a file or the triangles of a group
        if not isinstance(painted, tuple):
            return np.empty(0, int)
        points = self.points[self.body_of_point == number][list(painted)]
        return self.cells_around(points, np.full(len(points), number))

    def cells_around(self, points: Positions, body: Indices) -> Indices:
        """Return the numbers (k,) of the cells that contain points (k, 3) of bodies (k,)."""
        of_cell = self.body_of_node[self.cells[:, 0]]
        around = np.empty(len(points), int)
        for number in np.unique(body):
            own = np.flatnonzero(of_cell == number)
            inside = body == number
            # cells are cubes, so a point's cell has the nearest centre in the max norm
            around[inside] = own[KDTree(self.middles[own]).query(points[inside], p=np.inf)[1]]
        return around


@dataclass(frozen=True)
class Drawable:
    """Bodies in time, and the scene with their obstacles and forces.

    name      : name of the file, for messages
    pinned    : which nodes (n,) are pinned
    triangles : (f, 3) surface points of each triangle
    times     : times of the frames (T,) [s]
    nodes     : function from the number of a frame to node positions (n, 3) [m]
    embedding : W (v, n): surface points = W @ node positions
    array     : function from the name of a dataset of the result to its values
    solids    : surfaces at time 0 of obstacles that have a mesh, by obstacle number
    von_mises : function from the number of a frame to nodal stress (n,) [Pa]; None if not stored
    frequencies : (T - 1,) [Hz] of the modes that frames after the first show; empty for a run
    """

    name: str
    scene: SceneFile
    rest: BodiesAtRest
    pinned: Mask
    triangles: Indices
    times: Floats
    nodes: Callable[[int], Positions]
    embedding: csr_array
    array: Callable[[str], Array]
    solids: Mapping[int, Surface]
    von_mises: Callable[[int], Floats] | None = None
    frequencies: Floats = field(default_factory=lambda: np.empty(0))

    def moment(self, index: int) -> str:
        """Return the caption of a frame: its time, or number and frequency of its mode."""
        if 0 < index <= len(self.frequencies):
            return f"mode {index}: {self.frequencies[index - 1]:.4g} Hz"
        return f"t = {self.times[index]:.3f} s"

    @property
    def title(self) -> str:
        """Title of the scene, or the file's name."""
        return self.scene.title or Path(self.name).stem

    def surface(self, index: int) -> Positions:
        """Return the surface points (v, 3) [m] of a frame."""
        return np.asarray(self.embedding @ self.nodes(index))

    def fixed(self, index: int) -> Floats:
        """Return the share (v,) in [0, 1] of pinned or anchored nodes in each surface point."""
        fixed = self.pinned.copy()
        for anchor in self.scene.tables("anchor"):
            if within(float(self.times[index]), 0.0, anchor.table.stop):
                fixed |= self.rest.find(anchor)
        return self.on_surface(fixed.astype(float), 1.0)

    def on_surface(self, numbers: Floats, most: float = np.inf) -> Floats:
        """Return nodal values (n,) interpolated to surface points (v,), clipped to [0, most]."""
        return np.asarray(np.clip(self.embedding @ numbers, 0, most))


def drawable_of_result(run: Result, name: str = "") -> Drawable:
    """Return the bodies of a result. Raises InputError if they cannot be drawn.

    name : name of the file, for messages; the result's own if empty
    """
    name = name or str(run.path)
    scene = read_scene(run)
    if "embedding/weights" not in run:
        raise InputError(f"{name} has no surface to draw: its scene says output.surface = false")
    if not len(run.frames):
        raise InputError(f"{run.path} has no finished frame")
    nodes = run.lattice.nodes[:]
    bodies = run.body_of("lattice"), run.body_of("surface")
    pinned = np.zeros(len(nodes), bool)
    if "lattice/pinned" in run:
        pinned[run.indices("lattice/pinned")] = True

    def von_mises(index: int) -> Floats:
        return run.frames.von_mises[index].astype(float)

    return Drawable(
        name=name,
        scene=scene,
        rest=BodiesAtRest(nodes, run.indices("lattice/cells"), run.surface.points[:], *bodies),
        pinned=pinned,
        triangles=run.indices("surface/triangles"),
        times=run.frames.time[:],
        nodes=lambda index: run.frames.position[index],
        embedding=run.embedding,
        array=lambda name: run.indices(name) if name == "lattice/springs" else run[name][:],
        solids=solids_of(run),
        von_mises=von_mises if "von_mises" in run.frames else None,
        frequencies=np.ravel(run.attributes.get("frequencies", [])),
    )


def solids_of(run: Result) -> dict[int, Surface]:
    """Return the obstacle surfaces of a result, by obstacle number. Raises InputError."""
    if "obstacle/points" not in run:
        return {}
    points = run["obstacle/points"][:]
    triangles = run.indices("obstacle/triangles")
    numbers = run["obstacle/number"][:]
    if not (np.abs(points) < FARTHEST).all():
        raise InputError(f"{run.path} is damaged: the points of its obstacles are not finite")
    return {
        int(number): compact(points, triangles[numbers == number]) for number in np.unique(numbers)
    }


def read_scene(run: Result) -> SceneFile:
    """Return the validated scene of a result. Raises InputError."""
    try:
        return SceneFile.model_validate(run.scene)
    # ValueError includes pydantic's ValidationError
    except (InputError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{run.path} was run by another version, with a scene unknown to this one"
        ) from error
