"""Prepare a surface: repair, reduce, join or turn it in named steps, then scale and place it."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import wraps
from typing import TYPE_CHECKING, Any

import numpy as np

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

# share of the area below which a repair counts as failed [-]; MeshFix keeps a few per
# cent of overlapping parts or double-walled tubes
LEAST_AREA_KEPT = 0.5
# share of the area that a repair may change without a warning [-]; too little to see
MOST_CHANGED = 0.01
# largest coordinate that is repaired [file's unit]; MeshFix crashes on larger values
LARGEST_COORDINATE = 1e12
Step = Callable[..., Surface]


def prepare(
    surface: Surface,
    steps: Sequence[str | dict[str, Any]],
    size: float | None = None,
    base: Sequence[float] | None = None,
) -> Surface:
    """Return the surface and its groups after the steps, scaled and then moved.

    steps : names of steps, or {name: value} for a step that takes a value (see STEPS)
    size  : longest side of the bounding box [m]; the surface is scaled about the origin
    base  : (3,) target of the middle of the bounding box's bottom face [m]

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
        shift = np.asarray(base, float) - foot
        surface = surface.moved(lambda points: points + shift)
    return surface


def merge(surface: Surface) -> Surface:
    """Merge points of equal position, and drop degenerate triangles and unused points.

    Raises InputError if all triangles are degenerate.
    """
    triangles = merged_triangles(surface)
    if len(triangles) == 0:
        raise InputError("all triangles are degenerate")
    return compact(surface.points, triangles)


def largest_part(surface: Surface) -> Surface:
    """Return the connected part of the largest area."""
    import igl

    labels = part_labels(surface)
    areas = np.bincount(labels, igl.doublearea(surface.points, surface.triangles))
    return compact(surface.points, surface.triangles[labels == areas.argmax()])


def about_middle(step: Step) -> Step:
    """Return a step that works with coordinates from the bounding box's middle, to round less."""

    @wraps(step)
    def centred(surface: Surface, *values: Any) -> Surface:
        middle = bounds_of(surface).mean(axis=0)
        result = step(Surface(surface.points - middle, surface.triangles), *values)
        return Surface(result.points + middle, result.triangles)

    return centred


@about_middle
def union(surface: Surface) -> Surface:
    """Join the closed parts into a single solid.

    Each part counts as solid, so a cavity is filled.

    Raises InputError if a part is not closed, or not wound consistently.
    """
    # from the extra "mesh"
    import manifold3d

    surface = merge(surface)
    solids = []
    labels = part_labels(surface)
    for number in range(labels.max() + 1):
        part = compact(surface.points, surface.triangles[labels == number])
        report = examine(part)
        outwards = part.triangles if report.volume > 0 else part.triangles[:, ::-1]
        solid = solid_of(Surface(part.points, outwards))
        if solid is None:
            raise InputError(
                f"part {number} is no closed, consistently wound surface "
                f"({report.boundary_edges} boundary edges, {report.nonmanifold_edges} with more "
                f"than two triangles, {report.inconsistent_edges} inconsistent)"
            )
        solids.append(solid)
    return surface_of(manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add))


def solid_of(surface: Surface) -> "manifold3d.Manifold | None":
    """Return a surface as a solid of manifold3d; None if it is open or wound inconsistently."""
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
    """Close holes and remove self-intersections (pymeshfix, GPL-3, optional).

    Raises InputError if most of the surface is lost or a hole stays open.
    """
    # from the extra "repair"
    import pymeshfix

    surface = merge(surface)
    if np.abs(surface.points).max() > LARGEST_COORDINATE:
        raise InputError(f"coordinates beyond {LARGEST_COORDINATE:g} cannot be repaired")
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
    if abs(kept - 1) > MOST_CHANGED:
        log.warning(
            "prepare: 'repair' changed the surface's area by %+.0f%%: msmpetsc render draws it",
            100 * (kept - 1),
        )
    return repaired


@about_middle
def simplify(surface: Surface, faces: int, aggressiveness: int = 7) -> Surface:
    """Reduce to about ``faces`` triangles (quadric decimation); a closed surface stays closed.

    aggressiveness : of fast_simplification; less is slower and stays closer to the surface
    """
    surface = merge(surface)
    if faces >= len(surface.triangles):
        return surface
    # from the extra "mesh"
    import fast_simplification

    points, triangles = fast_simplification.simplify(
        surface.points, surface.triangles, target_count=int(faces), agg=aggressiveness
    )
    reduced = Surface(np.asarray(points, np.float64), np.asarray(triangles, np.int64))
    used, _ = edge_use(merged_triangles(reduced))
    if len(triangles) and examine(surface).closed and (used != 2).any():
        # an edge collapse may have closed up a thin place
        return repair(reduced)
    return reduced


@about_middle
def refine(surface: Surface, share: float) -> Surface:
    """Split the edges of a closed surface that are longer than ``share`` of its longest side.

    Raises InputError if the surface is not closed, or not wound consistently.
    """
    surface = merge(surface)
    low, high = bounds_of(surface)
    solid = solid_of(surface)
    if solid is None:
        raise InputError("it is no closed, consistently wound surface")
    return surface_of(solid.refine_to_length(share * float((high - low).max())))


def orient(surface: Surface) -> Surface:
    """Wind triangles consistently and patches outwards, or inwards if a patch bounds a cavity.

    The triangles of a patch are connected by edges of exactly two triangles. A patch bounds a
    cavity if it lies inside an odd number of other patches. An open patch is wound so that most of
    its area faces outwards.

    Raises InputError if the surface has a single side.
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
    """Return, for each patch, the number (p,) of other patches that enclose it.

    patch : (f,) patch of each triangle
    """
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
        candidates = within[patch]
        if candidates.any():
            is_outside = ~is_inside(part, middles[candidates])
            outside = np.bincount(patch[candidates], is_outside, len(parts))
            depths += within & (outside == 0)
    return depths


def rotate(surface: Surface, turn: dict[str, Any]) -> Surface:
    """Turn the surface about a unit axis through the origin: {"axis": [x, y, z], "degrees": d}."""
    # imported here because it is slow and few scenes need it
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_rotvec(np.deg2rad(turn["degrees"]) * np.array(turn["axis"]))
    return surface.moved(rotation.apply)


STEPS: dict[str, Step] = {
    step.__name__: step
    for step in (merge, largest_part, union, repair, simplify, refine, orient, rotate)
}


def _apply(surface: Surface, name: str, value: object) -> Surface:
    """Run a step and keep the groups. Raises InputError with the name of the step if it fails."""
    try:
        result = STEPS[name](surface, *([] if value is None else [value]))
    except InputError as error:
        raise InputError(f"prepare: '{name}': {error}") from error
    # the libraries do not document their exceptions on bad meshes
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and (expected := as_expected(error)):
            # the message is a single line that names the missing extra
            raise InputError(f"prepare: '{name}': {expected}") from error
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise InputError(f"prepare: '{name}' failed ({reason})") from error
    if len(result.triangles) == 0 or not np.isfinite(result.points).all():
        raise InputError(f"prepare: '{name}' left no usable mesh")
    return result if result.groups else replace(result, groups=surface.groups)


def part_labels(surface: Surface) -> Indices:
    """Return the number (f,) of the connected part of each triangle; equal positions connect."""
    import igl

    corners = first_of_equal(surface.points)[surface.triangles]
    labels = igl.vertex_components(corners)[corners[:, 0]]
    parts: Indices = np.unique(labels, return_inverse=True)[1]
    return parts
