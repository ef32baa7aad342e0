"""Preparing a surface: named steps that mend, reduce, join or turn it, then its size and where it stands.

The same step of the same mesh makes the same mesh: of a large one, that takes seconds to repair, it is kept on disk.
"""

import hashlib
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import wraps
from importlib.metadata import distributions
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import numpy as np
import pooch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from msmpetsc.backend.arrays import Indices
from msmpetsc.comm import log
from msmpetsc.errors import InputError, as_expected
from msmpetsc.geometry.surface import (
    Surface,
    bounds_of,
    compact,
    edge_use,
    examine,
    first_of_equal,
    is_inside,
    merged_triangles,
)

if TYPE_CHECKING:
    import manifold3d

# A repair that keeps less than this of the area did not mend the body but lost it: of
# overlapping parts or double-walled tubes MeshFix keeps a few per cent.
LEAST_AREA_KEPT = 0.5
# share of the area that a repair may change without a word
RETOUCHED = 0.01
# share of the mean thickness 2 V / A within which a surface counts as unchanged
NEAR = 0.01
FARTHEST = 1e12  # in the file's own unit
LARGE = 20_000  # triangles
MOST_FILES = 32  # of some megabytes each; the oldest go first
Step = Callable[..., Surface]
LIBRARIES = ("fast-simplification", "manifold3d", "pymeshfix")


def prepare(
    surface: Surface,
    steps: Sequence[str | dict[str, Any]],
    size: float | None = None,
    base: Sequence[float] | None = None,
) -> Surface:
    """Return the surface after the steps, then scaled, then moved, with its groups where they lie.

    steps : each the name of a step, or {name: value} for one that takes a value (see STEPS)
    size  : longest side of the bounding box [m]; scaled about the origin
    base  : (3,) where the middle of the bounding box's bottom face stands [m]

    Raises InputError naming the step that failed.
    """
    for step in steps:
        name, value = next(iter(step.items())) if isinstance(step, dict) else (step, None)
        surface = _apply(surface, name, value)
    if size is not None:
        low, high = bounds_of(compact(surface.points, surface.triangles))
        if (high - low).max() == 0:
            raise InputError("prepare: a mesh without extent cannot be given a size")
        factor = size / (high - low).max()
        surface = surface.moved(lambda points: points * factor)
    if base is not None:
        low, high = bounds_of(compact(surface.points, surface.triangles))
        foot = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
        way = np.asarray(base, float) - foot
        surface = surface.moved(lambda points: points + way)
    return surface


def merge(surface: Surface) -> Surface:
    """Merge points of equal position; drop degenerate triangles and unused points."""
    return compact(surface.points, merged_triangles(surface))


def largest_part(surface: Surface) -> Surface:
    """Keep the connected part of the largest area."""
    import igl

    labels = part_labels(surface)
    areas = np.bincount(labels, igl.doublearea(surface.points, surface.triangles))
    return compact(surface.points, surface.triangles[labels == areas.argmax()])


def about_middle(step: Step) -> Step:
    """Return a step that sees the surface about the middle of its box, where numbers round least."""

    @wraps(step)
    def centred(surface: Surface, *values: Any) -> Surface:
        middle = bounds_of(surface).mean(axis=0)
        result = step(Surface(surface.points - middle, surface.triangles), *values)
        return Surface(result.points + middle, result.triangles)

    return centred


@about_middle
def union(surface: Surface) -> Surface:
    """Join the closed parts into one solid. Each counts as solid, so a cavity is filled."""
    import manifold3d  # of the extra "mesh"

    surface, solids = merge(surface), []
    labels = part_labels(surface)
    for number in range(labels.max() + 1):
        part = compact(surface.points, surface.triangles[labels == number])
        report = examine(part)
        outwards = part.triangles if report.volume > 0 else part.triangles[:, ::-1]
        solid = solid_of(Surface(part.points, outwards))
        if solid is None:
            raise InputError(
                f"part {number} is no closed, consistently wound surface "
                f"({report.boundary_edges} boundary edges, {report.nonmanifold_edges} with more than "
                f"two triangles, {report.inconsistent_edges} inconsistent)"
            )
        solids.append(solid)
    return surface_of(manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add))


def solid_of(surface: Surface) -> "manifold3d.Manifold | None":
    """Return what a surface encloses as a solid of manifold3d, of the extra "mesh".

    None stands for a surface that is not closed, or not wound consistently.
    """
    import manifold3d

    triangles = np.ascontiguousarray(surface.triangles, np.uint64)
    solid = manifold3d.Manifold(manifold3d.Mesh64(surface.points, triangles))
    return None if solid.status() != manifold3d.Error.NoError or solid.is_empty() else solid


def surface_of(solid: "manifold3d.Manifold") -> Surface:
    """Return the surface of a solid of manifold3d."""
    mesh = solid.to_mesh64()
    return Surface(mesh.vert_properties[:, :3].copy(), mesh.tri_verts.astype(np.int64))


@about_middle
def repair(surface: Surface) -> Surface:
    """Close holes and remove self-intersections (pymeshfix, GPL-3, optional)."""
    import pymeshfix  # of the extra "repair"

    surface = merge(surface)
    if np.abs(surface.points).max() > FARTHEST:  # numbers much larger crash it
        raise InputError(f"coordinates beyond {FARTHEST:g} cannot be repaired")
    fix = pymeshfix.MeshFix(surface.points, surface.triangles.astype(np.int32))
    fix.repair(joincomp=False, remove_smallest_components=False)
    repaired = Surface(np.asarray(fix.points, np.float64), np.asarray(fix.faces, np.int64))
    if len(repaired.triangles) == 0:
        raise InputError("nothing of the surface was left")
    report = examine(repaired)
    kept = report.area / examine(surface).area
    if kept < LEAST_AREA_KEPT:
        raise InputError(
            f"only {kept:.1%} of the surface's area was left: its parts overlap or have two walls "
            '(try "largest_part" or "union" before)'
        )
    if not report.closed:
        raise InputError(f"{report.boundary_edges} boundary edges could not be closed")
    return repaired


def _warn_of_change(before: Surface, after: Surface) -> None:
    """Warn if a repair has taken away, or has added, more of the surface than RETOUCHED."""
    report = examine(after)
    near = NEAR * 2 * abs(report.volume) / report.area
    gone, new = _share_beyond(before, after, near), _share_beyond(after, before, near)
    if max(gone, new) > RETOUCHED:
        log.warning(
            "prepare: 'repair' took %.0f%% of the surface's area away, and %.0f%% of the area is new: "
            "msmpetsc render draws the scene",
            100 * gone, 100 * new,
        )  # fmt: skip


def _share_beyond(surface: Surface, other: Surface, distance: float) -> float:
    """Return the share of a surface's area that lies farther than a distance from another surface."""
    import igl

    middles = surface.points[surface.triangles].mean(axis=1)
    areas = igl.doublearea(surface.points, surface.triangles)
    squares = igl.point_mesh_squared_distance(middles, other.points, other.triangles)[0]
    return float(areas[squares > distance**2].sum() / areas.sum())


@about_middle
def simplify(surface: Surface, faces: int, haste: int = 7) -> Surface:
    """Reduce to about this many triangles (quadric decimation); a closed surface stays closed.

    haste : of fast_simplification, which with less goes on to larger errors more slowly, and ends nearer to the surface
    """
    surface = merge(surface)
    if faces >= len(surface.triangles):
        return surface
    import fast_simplification  # of the extra "mesh"

    points, triangles = fast_simplification.simplify(
        surface.points, surface.triangles, target_count=int(faces), agg=haste
    )
    reduced = Surface(np.asarray(points, np.float64), np.asarray(triangles, np.int64))
    used, _ = edge_use(merged_triangles(reduced))
    if len(triangles) and examine(surface).closed and (used != 2).any():
        return repair(reduced)  # collapsing edges can pinch thin places
    return reduced


@about_middle
def refine(surface: Surface, share: float) -> Surface:
    """Split the edges of a closed surface that are longer than this share of its longest side."""
    surface = merge(surface)
    low, high = bounds_of(surface)
    solid = solid_of(surface)
    if solid is None:
        raise InputError("it is no closed, consistently wound surface")
    return surface_of(solid.refine_to_length(share * float((high - low).max())))


def orient(surface: Surface) -> Surface:
    """Wind the triangles consistently, and each patch outwards, or inwards if it bounds a cavity.

    A patch hangs together by edges of exactly two triangles. It bounds a cavity if it lies in an
    odd number of other patches. An open patch looks away from its own middle with most of its area.
    """
    import igl

    merged = first_of_equal(surface.points)[surface.triangles]
    turned, patch = igl.bfs_orient(merged)
    used, forward = edge_use(turned)
    if ((used == 2) & (forward != 1)).any():
        raise InputError("it has one side only, as a Möbius band: no winding is consistent")
    wound, _ = igl.orient_outward(surface.points, turned, patch[:, None])
    cavity = _depths(Surface(surface.points, wound), patch)[patch] % 2 == 1
    wound[cavity] = wound[cavity, ::-1]
    flipped = (wound != merged).any(axis=1)
    triangles = np.where(flipped[:, None], surface.triangles[:, [0, 2, 1]], surface.triangles)
    return Surface(surface.points, triangles)


def _depths(surface: Surface, patch: Indices) -> Indices:
    """Return in how many other patches (p,) each patch of triangles (f,) lies."""
    order = np.argsort(patch, kind="stable")
    ends = np.flatnonzero(np.diff(patch[order])) + 1
    parts = [
        compact(surface.points, triangles) for triangles in np.split(surface.triangles[order], ends)
    ]
    low, high = np.array([bounds_of(part) for part in parts]).swapaxes(0, 1)
    middles = surface.points[surface.triangles].mean(axis=1)
    depths = np.zeros(len(parts), np.int64)
    for number, part in enumerate(parts):
        within = (low[number] < low).all(axis=1) & (high < high[number]).all(axis=1)
        asked = within[patch]
        if asked.any():
            outside = np.bincount(patch[asked], ~is_inside(part, middles[asked]), len(parts))
            depths += within & (outside == 0)
    return depths


def rotate(surface: Surface, turn: dict[str, Any]) -> Surface:
    """Turn about an axis through the origin: {"axis": [x, y, z], "degrees": d}."""
    from scipy.spatial.transform import Rotation  # a slow import for what few scenes do

    axis = np.asarray(turn["axis"], float)
    rotation = Rotation.from_rotvec(np.deg2rad(turn["degrees"]) * axis / np.linalg.norm(axis))
    return surface.moved(rotation.apply)


STEPS: dict[str, Step] = {
    step.__name__: step
    for step in (merge, largest_part, union, repair, simplify, refine, orient, rotate)
}


def _apply(surface: Surface, name: str, value: object) -> Surface:
    """Run a step, which leaves groups where they lie.

    Raises InputError with the name of the step if it fails.
    """
    try:
        result = cached(STEPS[name], surface, *([] if value is None else [value]))
    except InputError as error:
        raise InputError(f"prepare: '{name}': {error}") from error
    except Exception as error:  # what the libraries below raise on odd meshes is not documented
        if isinstance(error, ModuleNotFoundError) and (expected := as_expected(error)):
            raise InputError(
                f"prepare: '{name}': {expected}"
            ) from error  # one line says which extra it needs
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise InputError(f"prepare: '{name}' failed ({reason})") from error
    if len(result.triangles) == 0 or not np.isfinite(result.points).all():
        raise InputError(f"prepare: '{name}' left no usable mesh")
    # here, as a result from the cache is told, too
    if name == repair.__name__:
        _warn_of_change(surface, result)
    return result if result.groups else replace(result, groups=surface.groups)


def cached(step: Step, surface: Surface, *values: object) -> Surface:
    """Return the result of a step; of a large mesh it is kept in a cache on disk."""
    if len(surface.triangles) < LARGE or step is rotate:  # which moves groups, too
        return step(surface, *values)
    versions = [package.version for name in LIBRARIES for package in distributions(name=name)]
    digest = hashlib.sha256(
        Path(__file__).read_bytes() + repr((step.__name__, values, versions)).encode()
    )
    digest.update(surface.points.tobytes() + surface.triangles.tobytes())
    path = Path(pooch.os_cache("msmpetsc"), "prepared", f"{digest.hexdigest()}.npz")
    with (
        suppress(OSError, ValueError, KeyError, EOFError, BadZipFile),
        np.load(path) as arrays,
    ):  # there, and whole
        return Surface(arrays["points"], arrays["triangles"])
    result = step(surface, *values)
    with suppress(OSError):  # a full disk, a home that cannot be written
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f"{path.name}.{os.getpid()}.part.npz")
        np.savez(part, points=result.points, triangles=result.triangles)
        part.replace(path)  # a process that reads meanwhile finds all or nothing
        for old in sorted(path.parent.glob("*.npz"), key=os.path.getmtime)[:-MOST_FILES]:
            old.unlink(missing_ok=True)
    return result


def part_labels(surface: Surface) -> Indices:
    """Return the number (f,) of the connected part of each triangle; points of equal position connect."""
    triangles = first_of_equal(surface.points)[surface.triangles]
    links = triangles[:, [0, 1, 1, 2]].reshape(-1, 2).T
    n = len(surface.points)
    _, labels = connected_components(coo_array((np.ones(len(links[0])), links), shape=(n, n)))
    parts: Indices = np.unique(labels[triangles[:, 0]], return_inverse=True)[1]
    return parts
