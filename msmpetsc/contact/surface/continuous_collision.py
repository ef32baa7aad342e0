"""Continuous collision detection (CCD): the share of straight paths on which no triangles cross.

The broad phase finds the pairs that may meet on the paths. The narrow phase is ipctk's additive CCD
(Li, Kaufman and Jiang 2021, Codimensional Incremental Potential Contact). A translation that all
points share is ignored. Long paths are taken piece by piece.
"""

from typing import TYPE_CHECKING

import numpy as np

from msmpetsc.backend.arrays import Positions, Rows

if TYPE_CHECKING:
    import ipctk

    from msmpetsc.contact.surface.barrier import Barrier, CandidateSets

# Share of the path to a crossing that a step takes [-]
TAKEN = 0.9
# Displacement of points in a piece of a long path [mean edges]
PIECE = 2.0
# Greatest number of pieces of a path; a longer path is shortened
PIECES = 200
# Greatest norm of the linear part that boxes leave out [-]; the allowance for a larger
# part would enlarge the boxes
STRETCHED = 0.2


def candidates_on_paths(
    mesh: "ipctk.CollisionMesh", points: Positions, near: float, moved: Rows | None
) -> "ipctk.Candidates":
    """Return the pairs that may come closer than ``near`` [m] on the straight paths of points.

    Displacements are m = c + G x + r. Their linear part G x would enlarge the boxes around paths.
    If a pair is closer than d on its path, ``|x - x' + t (r - r')| < d + |G| |x - x'|``. Hence
    ``|x - x'| < (d + 2 max |r|) / (1 - |G|)``, and boxes around r suffice.

    points : (p, 3) [m]
    moved  : (p, 3) displacements along the paths [m]; None if points stay
    """
    import ipctk

    candidates, ends = ipctk.Candidates(), [np.asfortranarray(points)]
    if moved is not None:
        rest, linear = _without_linear_part(points, moved)
        ends += [np.asfortranarray(points + rest)]
        near += linear / (1 - linear) * (near + 2 * float(np.linalg.norm(rest, axis=1).max()))
    candidates.build(mesh, *ends, 0.5 * near, ipctk.LBVH())
    return candidates


def _without_linear_part(points: Positions, moved: Rows) -> tuple[Rows, float]:
    """Return displacements (p, 3) [m] without their linear part, and the norm of that part.

    If the norm is STRETCHED or more, the linear part stays, and the norm returned is 0.
    """
    x, rest = points - points.mean(axis=0), moved - moved.mean(axis=0)
    linear = np.linalg.pinv(x.T @ x, hermitian=True) @ (x.T @ rest)
    size = float(np.linalg.norm(linear, 2))
    return (rest - x @ linear, size) if size < STRETCHED else (rest, 0.0)


def collision_free_step(
    barrier: "Barrier", start: Positions, moved: Rows, sets: "CandidateSets | None" = None
) -> float:
    """Return the collision-free step length, at most 1, from start (p, 3) by ``moved`` (p, 3) [m].

    sets : candidate pairs of the paths; None to find the candidates of each piece of the paths. A
           step length then covers PIECES pieces at most.
    """
    moved = moved - moved.mean(axis=0)
    whole = 1
    if sets is None:
        length = float(np.linalg.norm(moved, axis=1).max())
        whole = max(int(np.ceil(length / (PIECE * barrier.edge))), 1)
    for piece in range(min(whole, PIECES)):
        begin, end = (start + i / whole * moved for i in (piece, piece + 1))
        near = barrier.candidates(begin, 0.0, end - begin) if sets is None else sets
        share = _share_to_crossing(barrier, begin, end, near)
        if share < 1:
            return TAKEN * (piece + share) / whole
    return min(PIECES / whole, 1.0)


def _share_to_crossing(
    barrier: "Barrier", start: Positions, end: Positions, sets: "CandidateSets"
) -> float:
    """Return the share of paths, at most 1, before the first crossing of candidate pairs."""
    paths = barrier.mesh, np.asfortranarray(start), np.asfortranarray(end), 0.0, barrier.ccd
    shares = (
        pairs.candidates.compute_collision_free_stepsize(*paths) for pairs in sets if len(pairs)
    )
    return min(shares, default=1.0)
