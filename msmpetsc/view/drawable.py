"""What is drawn: a body at its times, of a result, of a scene that was not run yet, or of a mesh alone."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.geometry.surface import Surface, compact
from msmpetsc.results.reader import Result
from msmpetsc.scene.bodies import OF_REGIONS
from msmpetsc.scene.schema import SceneFile
from msmpetsc.view.overlays import Overlays, Rest, SurfaceAtRest, fixed_nodes, overlays_at

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from msmpetsc.build import Model
    from msmpetsc.scene.reading import Scene
    from msmpetsc.view.camera import Camera

DRAWN = ("lattice/cells", "surface/points", "surface/triangles", "frames/kinetic", "frames/elastic", "frames/potential")
FARTHEST = 1e15  # [m]: what is drawn has single precision, and its squares must be numbers, too


@dataclass(frozen=True)
class Drawable:
    """A body and the scene that says what stands beside it.

    name      : of its file, for messages
    scene     : None for a mesh alone
    triangles : (f, 3) of the surface points
    times     : (T,) of its frames [s]
    nodes     : number of a frame -> node positions (n, 3) [m]
    surface   : number of a frame -> surface points (v, 3) [m]
    embedding : W (v, n); None where the surface points are the nodes
    array     : name of a dataset of a result, "lattice/springs" -> its numbers
    solids    : surfaces at time 0 of obstacles that are meshes or functions, by their numbers
    carry     : (v, w) numbers at the file's own points -> numbers at the surface points; None: they are the same
    """

    name: str
    scene: SceneFile | None
    rest: Rest
    triangles: np.ndarray
    times: np.ndarray
    nodes: Callable[[int], np.ndarray]
    surface: Callable[[int], np.ndarray]
    embedding: "csr_array | None"
    array: Callable[[str], np.ndarray]
    solids: Mapping[int, Surface]
    carry: "csr_array | None" = None

    @property
    def title(self) -> str:
        """Title of the scene, or the file's name."""
        return (self.scene and self.scene.title) or Path(self.name).stem

    @property
    def gravity(self) -> tuple[float, ...] | None:
        """The scene's acceleration (3,) [m/s^2], which says what is up."""
        return self.scene.gravity.acceleration if self.scene and self.scene.gravity else None

    @property
    def eye(self) -> tuple[float, ...] | None:
        """Direction (3,) of the scene's picture, from the body to the eye."""
        return self.scene.picture.eye if self.scene else None

    @property
    def springs(self) -> np.ndarray:
        """Nodes (s, 2) that springs join. Raises InputError where there are no such nodes."""
        springs, nodes = self.array("lattice/springs"), len(self.rest.nodes)
        if springs.size and not 0 <= springs.min() <= springs.max() < nodes:
            raise InputError(f"{self.name} is damaged: lattice/springs names what is not among its {nodes} nodes")
        return springs

    def fixed(self, index: int) -> np.ndarray:
        """Return how far each surface point is pinned or led at a frame, (v,) in [0, 1]."""
        if self.scene is None:
            return np.zeros(len(self.rest.points))
        return self.on_surface(fixed_nodes(self.scene, float(self.times[index]), self.rest).astype(float), 1.0)

    def on_surface(self, numbers: np.ndarray, most: float = np.inf) -> np.ndarray:
        """Return what numbers (n,) of the nodes are at the surface points, (v,) in [0, most]."""
        if not numbers.any():
            return np.zeros(len(self.rest.points))
        return np.clip(numbers if self.embedding is None else self.embedding @ numbers, 0, most)

    def overlays(self, index: int, bodies: np.ndarray, camera: "Camera") -> Overlays:
        """Return what stands beside the body at a frame; bodies: (b, 3) [m] as `overlays_at` has them."""
        if self.scene is None:
            return Overlays([], [], [], [], [])
        time, nodes = float(self.times[index]), self.nodes(index)
        return overlays_at(self.scene, time, self.rest, nodes, bodies, camera, self.solids)


def drawable_of_result(run: Result) -> Drawable:
    """Return what a result shows. Raises InputError where it cannot be drawn."""
    scene = read_scene(run)
    refuse_what_cannot_be_drawn(run, scene)
    if len(run.frames.time) == 0:
        raise InputError(f"{run.path} has no finished frame")
    return Drawable(
        name=str(run.path),
        scene=scene,
        rest=Rest(
            run.lattice.nodes[:],
            run.lattice.cells[:],
            run.surface.points[:],
            run.body_of("lattice"),
            run.body_of("surface"),
        ),
        triangles=run.surface.triangles[:],
        times=run.frames.time[:],
        nodes=lambda index: run.frames.position[index],
        surface=lambda index: surface_points(run, index),
        embedding=run.embedding,
        array=lambda name: run[name][:],
        solids=solids_of(run),
    )


def drawable_of_model(path: Path, scene: "Scene", model: "Model") -> Drawable:
    """Return what a scene is before its first step, from the model that one process built of it."""
    from scipy.sparse import csr_array

    lattice, surface, embedding = model.lattice, model.surface, model.embedding
    if surface is None or embedding is None:
        raise InputError(f"{path} has no surface to draw: it says output.surface = false")
    W = csr_array((embedding.weights, embedding.indices, embedding.indptr), shape=(embedding.points, lattice.owned))
    start = np.asarray(model.start[0])[: lattice.owned]
    arrays = {
        "lattice/cell_kind": lattice.cell_kind,
        "lattice/springs": lattice.global_numbers[lattice.springs],
        "lattice/rest_length": lattice.rest_length,
    }
    return Drawable(
        name=str(path),
        scene=with_painted_points(scene),
        rest=Rest(
            lattice.nodes[: lattice.owned],
            lattice.cells,
            surface.points,
            lattice.body[: lattice.owned],
            model.body_of_point,
        ),
        triangles=surface.triangles,
        times=np.zeros(1),
        nodes=lambda _: start,
        surface=lambda _: W @ start,
        embedding=W,
        array=arrays.__getitem__,
        solids=model.solids,
    )


def drawable_of_surface(
    path: Path,
    surface: Surface,
    scene: SceneFile | None = None,
    body: np.ndarray | None = None,
    solids: Mapping[int, Surface] | None = None,
) -> Drawable:
    """Return a mesh as it lies in its file, in the file's own unit; or the surface of a scene without its lattice.

    body   : (v,) numbers of the bodies of its points; None: there is but one
    solids : of its obstacles, as Drawable has them
    """
    no_cells, body = np.empty((0, 8), int), np.zeros(len(surface.points), int) if body is None else body
    return Drawable(
        name=str(path),
        scene=scene,
        rest=SurfaceAtRest(surface.points, no_cells, surface.points, body, body),
        triangles=surface.triangles,
        times=np.zeros(1),
        nodes=lambda _: surface.points,
        surface=lambda _: surface.points,
        embedding=None,
        array={"lattice/cell_kind": no_cells[:, 0], "lattice/springs": no_cells[:, :2]}.__getitem__,
        solids=solids or {},
    )


def with_painted_points(scene: "Scene") -> SceneFile:
    """Return the scene with the numbers of painted points in place of the files that list them."""

    def read(table):
        if not isinstance(table.region.painted, str):
            return table
        numbers = tuple(int(word) for word in (scene.folder / table.region.painted).read_text().split())
        return table.model_copy(update={"region": table.region.model_copy(update={"painted": numbers})})

    def with_points(tables):
        return tables.model_copy(update={kind: tuple(map(read, getattr(tables, kind))) for kind in OF_REGIONS})

    return with_points(scene).model_copy(update={"body": tuple(map(with_points, scene.body))})


def refuse_what_cannot_be_drawn(run: Result, scene: SceneFile) -> None:
    """Raise InputError unless what is drawn is there, of matching shapes, and names points and nodes that exist."""
    if "embedding/weights" not in run:
        raise InputError(f"{run.path} has no surface to draw: its scene says output.surface = false")
    nodes, points = len(run["lattice/nodes"]), len(run["surface/points"])
    for name in DRAWN:
        _ = run[name]  # which must be there
    for name, count in {"lattice/cells": nodes, "surface/triangles": points}.items():
        numbers = run[name][:]
        if numbers.size == 0 or not 0 <= numbers.min() <= numbers.max() < count:
            raise InputError(f"{run.path} is damaged: {name} is empty, or names what is not among its {count}")
    refuse_other_bodies(run, scene)
    if not (np.abs(run["lattice/nodes"][:]) < FARTHEST).all() or not np.isfinite(run["embedding/weights"][:]).all():
        raise InputError(f"{run.path} is damaged: its lattice or its embedding has numbers that are none")
    _ = run.embedding  # which checks itself


def refuse_other_bodies(run: Result, scene: SceneFile) -> None:
    """Raise InputError unless the result has the bodies of its scene, and these the points that it paints."""
    of_point = run.body_of("surface")
    for of_body in (of_point, run.body_of("lattice")):
        if not np.array_equal(np.unique(of_body), np.arange(len(scene.meshes))):
            raise InputError(f"{run.path} is damaged: its bodies are not those of its scene")
    own = np.bincount(of_point)
    for table in chain.from_iterable(scene.tables(kind) for kind in ("pin", "anchor", "force")):
        painted, number = table.table.region.painted, table.body or 0
        if isinstance(painted, tuple) and max(painted) >= own[number]:
            raise InputError(f"{run.path} is damaged: its scene names painted points beyond its {own[number]}")


def solids_of(run: Result) -> dict[int, Surface]:
    """Return the surfaces of obstacles that a result holds. Raises InputError where they are damaged."""
    if "obstacle/points" not in run:
        return {}
    points, triangles, numbers = (run[f"obstacle/{name}"][:] for name in ("points", "triangles", "number"))
    if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(points):
        raise InputError(f"{run.path} is damaged: obstacle/triangles names what is not among its {len(points)} points")
    if len(numbers) != len(triangles) or not (np.abs(points) < FARTHEST).all():
        raise InputError(f"{run.path} is damaged: the surfaces of its obstacles are none")
    return {int(number): compact(points, triangles[numbers == number]) for number in np.unique(numbers)}


def read_scene(run: Result) -> SceneFile:
    """Return the scene of a result, as run, with its keys checked."""
    try:
        return SceneFile.model_validate(run.scene)
    except (InputError, ValueError, TypeError, AttributeError, RecursionError) as error:  # pydantic's among them
        raise InputError(f"{run.path} was run by another version, with a scene unknown to this one") from error


def surface_points(run: Result, index: int) -> np.ndarray:
    """Return the surface points (v, 3) of a frame [m]: as stored, or W @ positions."""
    if "frames/surface" in run:
        return run.frames.surface[index].astype(float)
    return run.embedding @ run.frames.position[index]
