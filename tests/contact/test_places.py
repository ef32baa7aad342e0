"""A place of contact counts once: aligned meshes, creases, few pairs, friction."""

from pathlib import Path

import ipctk
import numpy as np
import pytest
import trimesh
from block_scene import GRAVITY, model_of, play, solid_of, write_scene

from msmpetsc.contact.surface.barrier import Barrier, BarrierLaw
from msmpetsc.contact.surface.pairs import ContactSearch
from msmpetsc.contact.surface.places import CandidateSet
from msmpetsc.contact.surface.surface_contact import SurfaceContact
from msmpetsc.geometry.surface import Surface

# cells of a plate's grid along each side of 1 m
CELLS = 8
DHAT = 0.25 / CELLS
FRICTION = 0.3


def grid(bent: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the points and triangles of a grid over the unit square, folded along x = 1/2.

    bent : slope of the two sides, which form a V
    """
    along = np.arange(CELLS + 1) / CELLS
    points = np.array([[x, y, bent * abs(x - 0.5)] for x in along for y in along])
    first = np.arange(CELLS * (CELLS + 1)).reshape(CELLS, CELLS + 1)[:, :-1].ravel()
    next_row = first + CELLS + 1
    return points, np.vstack(
        [np.c_[first, next_row, first + 1], np.c_[first + 1, next_row, next_row + 1]]
    )


def plates() -> tuple[Barrier, np.ndarray, np.ndarray]:
    """Return the barrier of two plates, their points (p, 3), and a mask of the upper plate."""
    points, triangles = grid()
    both = np.vstack([points, points + np.array([0, 0, 2 * DHAT])])
    surface = Surface(both, np.vstack([triangles, triangles[:, ::-1] + len(points)]))
    upper = np.arange(len(both)) >= len(points)
    return (
        Barrier(surface, BarrierLaw(DHAT, 1.0, FRICTION, 1e-3), len(both)),
        both * [1, 1, 0],
        upper,
    )


def pushed(barrier: Barrier, points: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the energy at points, and its gradient."""
    contacts = barrier.contacts(barrier.candidates(points, 0.0), points)
    return barrier.energy(contacts, points), barrier.gradient(contacts, points)


def tip_energies(bent: float, tips: np.ndarray) -> np.ndarray:
    """Return the energies (k,) [a_v / 4] of a vertex at positions (k, 3) near a folded grid.

    The candidates are the vertex with each triangle of the grid, and no edges.
    """
    points, triangles = grid(bent)
    away = np.array([[0.5, 0.5, 9.0], [0.6, 0.5, 9.0], [0.5, 0.6, 9.0]])
    tip = len(points)
    surface = Surface(np.vstack([points, away]), np.vstack([triangles, [[tip, tip + 1, tip + 2]]]))
    barrier = Barrier(surface, BarrierLaw(DHAT, 1.0, 0.0, 0.0), tip + 3)
    candidates = ipctk.Candidates()
    candidates.fv_candidates = [
        ipctk.FaceVertexCandidate(face, tip) for face in range(len(triangles))
    ]
    at, energies = surface.points.copy(), []
    for at[tip] in tips:
        energies.append(barrier.energy(barrier.contacts((CandidateSet(candidates),), at), at))
    return np.array(energies) / (0.25 * barrier.mesh.vertex_areas[tip])


def b(distance: np.ndarray) -> np.ndarray:
    """Return the barrier b of distances [m]."""
    x = np.minimum(distance / DHAT, 1.0) ** 2
    return -((x - 1) ** 2) * np.log(x)


def slid(height: np.ndarray | float) -> np.ndarray:
    """Return positions (k, 3) on a line over vertices, edges and interiors of the grid."""
    x = np.linspace(0.25, 0.75, 4 * CELLS + 1)
    return np.column_stack([x, 0.25 + 0.5 * (x - 0.25), np.broadcast_to(height, x.shape)])


def test_a_vertex_that_slides_over_a_flat_patch_keeps_its_energy():
    energies = tip_energies(0.0, slid(0.4 * DHAT))
    assert energies == pytest.approx(b(np.array(0.4 * DHAT)), rel=1e-12)


def test_a_vertex_over_a_convex_edge_has_the_energy_of_the_nearest_place():
    tips = slid(0.3 * DHAT)
    beyond = np.abs(tips[:, 0] - 0.5)
    # The roof's slope is 1/2. Outside the region of the ridge a triangle is nearest.
    across = (tips[:, 2] + 0.5 * beyond) / np.hypot(1, 0.5)
    over_face = beyond > 0.5 * tips[:, 2]
    nearest = np.where(over_face, across, np.hypot(beyond, tips[:, 2]))
    assert tip_energies(-0.5, tips) == pytest.approx(b(nearest), rel=1e-9, abs=1e-15)


def test_a_vertex_in_a_concave_crease_has_both_sides_less_their_link():
    tips = slid(0.0)
    tips[:, 2] = 0.3 * DHAT + 0.5 * np.abs(tips[:, 0] - 0.5)
    aside = tips[:, 0] - 0.5
    near, far = (
        np.abs(tips[:, 2] - 0.5 * side) / np.hypot(1, 0.5)
        for side in (np.abs(aside), -np.abs(aside))
    )
    # The farther side counts if its nearest point is inside the side. Else this point
    # is on the link itself.
    foot = 0.5 * tips[:, 2] > np.abs(aside)
    other = np.where(foot, b(far) - b(np.hypot(aside, tips[:, 2])), 0.0)
    assert tip_energies(0.5, tips) == pytest.approx(b(near) + other, rel=1e-9, abs=1e-15)
    assert foot.any() and not foot.all()


def test_the_energy_over_a_vertex_is_that_beside_it():
    """The energy is the same over a vertex and beside it.

    IPC's sum is five times as large over a vertex, and pushes aligned plates aside.
    """
    barrier, points, upper = plates()
    shifts = DHAT * np.array([0.0, 0.1, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0])
    moved = (points + np.where(upper[:, None], [0.9 * s, 0.4 * s, 0.8 * DHAT], 0) for s in shifts)
    energies = np.array([pushed(barrier, at)[0] for at in moved])
    assert energies[0] < energies[1] and energies.max() < 1.3 * energies.min()


@pytest.mark.parametrize("seed", range(4))
def test_crumpled_surfaces_push_from_their_nearest_places_at_least(seed: int):
    """The gradient is the derivative of the energy for any choice of links."""
    barrier, points, upper = plates()
    random = np.random.default_rng(seed)
    at = (
        points
        + np.where(upper[:, None], [0.01, 0.02, DHAT], 0)
        + random.normal(size=points.shape) * 0.1 * DHAT
    )
    energy, gradient = pushed(barrier, at)
    candidates = barrier.candidates(at, 0.0)[0].candidates
    corners = barrier.mesh.edges, barrier.mesh.faces
    nearest = {}
    for pair in candidates.fv_candidates:
        square = pair.compute_distance(np.asfortranarray(at), *corners)
        nearest[pair.vertex_id] = min(square / DHAT**2, nearest.get(pair.vertex_id, 1.0))
    areas = 0.25 * barrier.mesh.vertex_areas
    least = sum(-areas[v] * (x - 1) ** 2 * np.log(x) for v, x in nearest.items())
    assert energy > least > 0
    way = random.normal(size=at.shape) * 1e-6 * DHAT
    change = pushed(barrier, at + way)[0] - pushed(barrier, at - way)[0]
    assert change == pytest.approx(2 * np.vdot(gradient, way), rel=1e-4)


@pytest.mark.parametrize("narrow", [0.5, 0.2, 0.05, 0.01])
def test_a_crease_opens(narrow: float):
    """The energy is positive, although some neighbours are not among the candidates.

    With links taken from the mesh it would be negative.
    """
    points, triangles = grid(4.0)
    barrier = Barrier(Surface(points, triangles), BarrierLaw(4 * DHAT, 1.0, 0.0, 0.0), len(points))
    barrier.leave_out_neighbours(points)
    points[:, 0] = 0.5 + narrow * (points[:, 0] - 0.5)
    energy, gradient = pushed(barrier, points)
    right = points[:, 0] > 0.5
    assert energy > 0 and gradient[right, 0].sum() < 0
    assert gradient[right, 0].max() < 0.02 * np.abs(gradient).max()


@pytest.mark.parametrize("shift", [0.0, 0.2])
def test_no_point_is_attracted_where_few_pairs_are_asked_for(shift: float):
    """A plate touches along a side, then turns flat; pairs beside this side are not candidates."""
    barrier, points, upper = plates()
    points[upper, 0] += shift / CELLS
    heights = 0.5 * DHAT + np.outer(
        [0.9 * CELLS, 0.5 * CELLS, 0.2 * CELLS, 0], points[upper, 0] * DHAT
    )
    points[upper, 2] = heights[0]
    sets = barrier.around(pushed(barrier, points)[1].any(axis=1), points, 0.05 / CELLS)
    for height in heights:
        points[upper, 2] = height
        contacts = barrier.contacts(sets, points)
        assert 0 < barrier.energy(contacts, points) <= (1 + 1e-9) * pushed(barrier, points)[0]
        assert barrier.gradient(contacts, points)[upper, 2].max() <= 1e-12


@pytest.mark.parametrize("shift", [0.0, 0.2])
def test_friction_has_the_push_for_its_limit(shift: float):
    """No friction limit is negative, although links have negative weights."""
    barrier, points, upper = plates()
    points[upper] += [shift / CELLS, 0, 0.5 * DHAT]
    contacts = barrier.contacts(barrier.candidates(points, 0.0), points)
    weights = [pair.weight for pair in contacts[0].fv_collisions + contacts[0].ev_collisions]
    assert shift == 0 or min(weights) < 0
    pairs, limits = barrier.friction_limits(contacts, points)
    push = -barrier.gradient(contacts, points)[upper, 2].sum()
    assert limits.min() > 0 and limits.sum() == pytest.approx(FRICTION * push, rel=0.02)
    assert len(np.unique(pairs, axis=0)) == len(pairs)


def test_the_projected_hessian_has_no_negative_part():
    """The Hessians of links are mostly negative, since links have negative weights."""
    barrier, points, upper = plates()
    points[upper] += [0.2 / CELLS, 0, 0.5 * DHAT]
    contacts = barrier.contacts(barrier.candidates(points, 0.0), points)
    kept, whole = (
        barrier.hessian(contacts, points, projected)[0].toarray() for projected in (True, False)
    )
    assert np.linalg.eigvalsh(kept)[0] > -1e-9 * np.abs(kept).max() > np.linalg.eigvalsh(whole)[0]


def test_cards_without_friction_stay_where_they_lie(tmp_path: Path):
    """Two cards of equal meshes, vertex over vertex, stay in place to 0.05 mm/s.

    IPC's sum over pairs pushes the upper card aside at 3 mm/s.
    """
    card = trimesh.creation.box([0.06, 0.04, 0.006]).subdivide().subdivide()
    card.export(tmp_path / "card.ply")
    everywhere = {"region": {"box": [[-1, -1, -1], [1, 1, 1]]}}
    tables = {
        "body": [
            {"mesh": {"source": "card.ply", "base": [0, 0, 0]}, "pin": [everywhere]},
            {"mesh": {"source": "card.ply", "base": [0, 0, 0.00619]}},
        ],
        "cages": {"cell_size": 0.006},
        "material": solid_of(1e6),
        "time": {"step": 0.01, "duration": 0.03},
        "gravity": GRAVITY,
        "self_contact": {"distance": 2e-4, "friction": 0.0},
    }
    model, frames = play(write_scene(tmp_path, **tables))
    upper = model.lattice.nodes[:, 2] > 0.0061
    way = (frames[-1].position - frames[0].position)[upper].mean(axis=0)
    assert np.linalg.norm(way[:2]) < 5e-5 * 0.03
    assert abs(way[2]) < 1.9e-4


def test_the_hessian_over_a_vertex_is_that_of_the_gradient(tmp_path: Path):
    """Blocks of equal meshes lie vertex over vertex, and the upper block slides.

    The Hessian of pairs of points was seven times that of the gradient.
    """
    trimesh.creation.box([0.2, 0.2, 0.2]).subdivide().export(tmp_path / "block.ply")
    tables = {
        "body": [{"mesh": {"source": "block.ply", "base": [0, 0, z]}} for z in (0, 0.2005)],
        "cages": {"cell_size": 0.1},
        "material": solid_of(1e6),
        "time": {"step": 0.01, "duration": 0.01},
        "self_contact": {"distance": 1e-3, "friction": 0.0},
    }
    model = model_of(write_scene(tmp_path, **tables))
    assert model.collision is not None
    q, move = model.lattice.nodes, 1e-8
    search = ContactSearch(model.collision)
    contact = SurfaceContact(search, search.begin_step(q, 0.0, 0.01), 0.01)
    slide, product, after, before = (np.zeros_like(q) for _ in range(4))
    slide[q[:, 2] > 0.2003, 0] = 1.0
    contact.at(q).hessian(False).add_product(slide, product)
    contact.at(q + move * slide).add_gradient(after)
    contact.at(q - move * slide).add_gradient(before)
    difference = np.vdot(slide, after - before) / (2 * move)
    assert np.vdot(slide, product) == pytest.approx(difference, rel=0.2)
