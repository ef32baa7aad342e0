"""Slits narrower than a cell: parts of cells, their copies, and bodies that open.

Convex bodies need no copies. The lattice is connected as the body is. A fork is compared with
theory and with finer cells.
"""

from pathlib import Path

import manifold3d
import numpy as np
import pytest
import trimesh
from block_scene import play, solid_of, write_scene
from conftest import result_on
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, shortest_path
from surfaces import body_of

from msmpetsc import open as open_result
from msmpetsc.geometry.cages import Cages, fill
from msmpetsc.geometry.embedding import embed
from msmpetsc.geometry.morton import decode_morton
from msmpetsc.lattice.topology import Topology, topology_of
from msmpetsc.view.drawable import drawable_of_result
from msmpetsc.view.mesh import drawn

H = 0.1
# the fork [cells]; its slit runs along x
LENGTH, BASE, WIDTH, DEPTH = 20, 4, 5, 2
# [Pa], [N]
YOUNG, FORCE = 1e6, 0.5


def box(low: list[float], high: list[float]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


def fork(slit: float, shift: float = 0.0) -> trimesh.Trimesh:
    """Return a bar with a slit of so many cells from its end to its base."""
    middle = WIDTH / 2 + shift
    bar = box([0, 0, 0], [LENGTH, WIDTH, DEPTH])
    gap = box([BASE, middle - slit / 2, -1], [LENGTH + 1, middle + slit / 2, DEPTH + 1])
    body = trimesh.boolean.difference([bar, gap], engine="manifold")
    body.apply_scale(H)
    return body.subdivide_to_size(1.5 * H)


def lips(gap: float) -> trimesh.Trimesh:
    """Return a plate of 20 x 8 x 3 cells with an arched slit that tapers to its closed ends."""
    x = np.linspace(-7, 7, 40)
    arch = np.cos(x / 14 * np.pi)
    width = gap * arch / 2 + 0.02
    outline = np.concatenate(
        [np.stack([x, 1.2 * arch - width], 1), np.stack([x, 1.2 * arch + width], 1)[::-1]]
    )
    slit = manifold3d.CrossSection([outline]).extrude(5).to_mesh()
    slit = trimesh.Trimesh(slit.vert_properties[:, :3] - [0, 0, 1], slit.tri_verts)
    plate = box([-10, -4, 0], [10, 4, 3])
    body = trimesh.boolean.difference([plate, slit], engine="manifold")
    body.apply_scale(H)
    return body.subdivide_to_size(H)


def cages_of(mesh: trimesh.Trimesh, h: float = H) -> tuple[Cages, Topology]:
    cages = fill([body_of(mesh)], h)
    return cages, topology_of(cages)


def components(net: Topology) -> int:
    """Return the number of connected parts of a lattice."""
    springs = net.springs().ends
    ends = coo_array((np.ones(len(springs)), springs.T), shape=(len(net.ijk),) * 2)
    return connected_components(ends, directed=False)[0]


def rotated(mesh: trimesh.Trimesh, rng: np.random.Generator) -> trimesh.Trimesh:
    mesh.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
    return mesh


CONVEX = {
    "block": lambda rng: trimesh.creation.box(rng.uniform(0.3, 6, 3)),
    "sheet": lambda rng: trimesh.creation.box([4, 5, rng.uniform(0.02, 0.6)]),
    "ball": lambda rng: trimesh.creation.icosphere(subdivisions=2, radius=rng.uniform(0.5, 4)),
    "rod": lambda rng: trimesh.creation.cylinder(rng.uniform(0.05, 1), rng.uniform(2, 8)),
}


@pytest.mark.parametrize("name", CONVEX)
def test_a_convex_body_has_no_copies(name: str):
    """A cell holds a single part of a convex body, and neighbouring cells meet in their face."""
    rng = np.random.default_rng(0)
    for turned in (False, True) * 5:
        mesh = CONVEX[name](rng)
        cages, net = cages_of(rotated(mesh, rng) if turned else mesh, 1.0)
        assert len(cages.copies.keys) == 0
        assert components(net) == 1


@pytest.mark.parametrize("seed", range(12))
def test_a_lattice_hangs_together_as_the_body_does(seed: int):
    """The lattice of boxes and of blocks with holes and slits has as many parts as the body."""
    rng = np.random.default_rng(seed)
    boxes = []
    for _ in range(rng.integers(2, 7)):
        part = rotated(trimesh.creation.box(rng.uniform(0.15, 3, 3)), rng)
        boxes.append(part.apply_translation(rng.uniform(-1.5, 1.5, 3)))
    if seed % 2:
        boxes = [trimesh.creation.box([4, 3, 3]), *boxes]
        body = trimesh.boolean.difference(boxes, engine="manifold")
    else:
        body = trimesh.boolean.union(boxes, engine="manifold")
    parts = [part.volume > 0 for part in body.split(only_watertight=False)]
    cages, net = cages_of(body, rng.uniform(0.3, 1.0))
    assert components(net) == sum(parts)
    h = cages.grids.cell_size
    assert cages.fills.mean(axis=(1, 2, 3)).sum() * h**3 == pytest.approx(body.volume, rel=0.02)


@pytest.mark.parametrize(("slit", "shift"), [(0.2, 0.0), (0.4, 0.2), (0.8, 0.0)])
def test_the_two_parts_of_a_slit_have_their_volumes_and_moments(slit: float, shift: float):
    """With walls along the grid both are exact, since the lines across the slit meet both walls."""
    cages, _ = cages_of(fork(slit, shift))
    ijk = decode_morton(cages.table.keys)
    middle = (ijk[:, 1] == WIDTH // 2) & (ijk[:, 0] > BASE)
    thickness = 0.5 - slit / 2 + np.array([shift, -shift])
    for number, near in enumerate(thickness):
        fills = cages.fills[middle].mean(axis=(1, 2, 3))
        own = np.isclose(fills, near, atol=1e-5)
        assert own.sum() == middle.sum() // (1 if shift == 0 else 2)
        # integral of y^2 about the cell's middle, from its face inwards
        begins = [-0.5, 0.5 - near][number]
        expected = ((begins + near) ** 3 - begins**3) / 3
        np.testing.assert_allclose(cages.moments[middle][own, 1], expected, atol=1e-5)


def test_copies_share_corners_at_the_end_of_the_slit_alone():
    """Cells at x = BASE share the nodes of the base; all nodes beyond are separate."""
    cages, net = cages_of(fork(0.3))
    ijk = decode_morton(net.keys)
    in_slit = (ijk[:, 1] == WIDTH // 2) & (ijk[:, 2] == 0)
    for i in range(BASE, LENGTH):
        copies = net.cells[in_slit & (ijk[:, 0] == i)]
        volumes = cages.materials_of(net.keys[in_slit & (ijk[:, 0] == i)])[0].mean(axis=1)
        # the end of the slit is in the face of the cells, so this copy has no volume
        copies = copies[volumes > 0.01]
        shared = np.intersect1d(*copies)
        assert len(copies) == 2
        assert (net.ijk[shared][:, 0] == BASE).all()
        assert len(shared) == (4 if i == BASE else 0)


@pytest.mark.parametrize("kind", ["affine", "cages"])
def test_points_beside_a_slit_at_the_first_cell_keep_their_places(kind: str):
    """Cells outside the grid have no corner in common with the first cell."""
    turned = fork(0.3, shift=1.0)
    turned.apply_transform(trimesh.transformations.rotation_matrix(np.pi, [0, 0, 1]))
    body = body_of(turned)
    cages = fill([body], H)
    net = topology_of(cages)
    weights = embed([body.surface.points], cages, net.table, kind)
    nodes = cages.grids.node_positions(net.ijk)
    np.testing.assert_allclose(weights @ nodes, body.surface.points, atol=1e-9)


def test_the_end_of_a_slit_follows_its_sides_alike_along_all_axes():
    """Points below the prongs follow nodes of the prong on their own side, whatever the order."""
    prongs = trimesh.boolean.difference(
        [box([0, 0, 0], [4, 2, 4]), box([1.4, -1, 1.2], [2.6, 3, 5])], engine="manifold"
    )
    prongs.apply_scale(H)
    followed = []
    for turn in range(3):
        across, up = turn, (2 + turn) % 3
        body = body_of(trimesh.Trimesh(np.roll(prongs.vertices, turn, axis=1), prongs.faces))
        cages = fill([body], H)
        net = topology_of(cages)
        ijk = decode_morton(net.keys)
        left, right = (
            np.isin(np.arange(len(net.ijk)), net.cells[(ijk[:, up] > 1) & is_on_side])
            for is_on_side in (ijk[:, across] < 2, ijk[:, across] > 1)
        )
        weights = embed([body.surface.points], cages, net.table, "affine")
        side = (right * 1.0 - left) * (net.ijk[:, up] > 2)
        followed.append(weights @ side)
    np.testing.assert_allclose(followed, followed[:1] * 3, atol=1e-12)


def test_the_surface_follows_its_own_part(tmp_path: Path):
    """If one side of the slit moves, the points of its own wall move along."""
    body = body_of(fork(0.3))
    cages = fill([body], H)
    net = topology_of(cages)
    for kind in ("affine", "cages", "mvc"):
        weights = embed([body.surface.points], cages, net.table, kind)
        nodes = cages.grids.node_positions(net.ijk)
        np.testing.assert_allclose(weights @ nodes, body.surface.points, atol=1e-6)
        # the prong whose cells a node belongs to labels the nodes beyond the end of the
        # slit
        fills = cages.materials_of(net.keys)[0].mean(axis=1)
        ijk = decode_morton(net.keys)
        side = np.zeros(len(net.ijk))
        for low in (True, False):
            on_side = ijk[:, 1] < WIDTH // 2 if low else ijk[:, 1] > WIDTH // 2
            reached = net.cells[on_side & (ijk[:, 0] > BASE + 1)].ravel()
            for _ in range(2):
                touching = np.isin(net.cells, reached).any(axis=1)
                touching &= (ijk[:, 0] > BASE + 1) & (fills > 0.01)
                reached = np.unique(net.cells[touching])
            side[reached] = -1.0 if low else 1.0
        points = body.surface.points
        far = points[:, 0] > (BASE + 4) * H
        moved = (weights @ side)[far]
        np.testing.assert_allclose(moved, np.sign(points[far, 1] - WIDTH * H / 2), atol=1e-9)


def pulled(folder: Path, mesh: trimesh.Trimesh, low: list, high: list, **tables: object) -> Path:
    """Write a static scene: a body held at x = 0, whose parts in two boxes are pulled apart."""
    mesh.export(folder / "body.ply")
    forces = [
        {"region": {"box": box}, "total": [0.0, pull, 0.0]}
        for box, pull in ((low, -FORCE), (high, FORCE))
    ]
    scene = {
        "mesh": {"source": "body.ply"},
        "cages": {"cell_size": H},
        "material": solid_of(YOUNG, 0.3),
        "time": {"step": 1.0, "duration": 1.0, "integrator": "static"},
        "pin": [{"region": {"box": [[-1, -1, -1], [0.01, 2, 2]]}}],
        "force": forces,
        "solver": {"error": 1e-4},
        "output": {"surface": True},
    }  # fmt: skip
    return write_scene(folder, **scene | tables)


TIPS = [[1.85, -1, -1], [2.1, 0.15, 2]], [[1.85, 0.35, -1], [2.1, 1, 2]]


def opening(path: Path, *overrides: str) -> tuple[float, int]:
    """Return how far the ends of the prongs move apart [m], and the number of CG iterations."""
    model, frames = play(path, *overrides)
    q = frames[-1].surface
    points = model.surface.points
    tip = points[:, 0] > LENGTH * H - 1e-6
    across = (q - points)[:, 1]
    high = points[:, 1] > WIDTH * H / 2
    return float(across[tip & high].mean() - across[tip & ~high].mean()), frames[-1].ksp_its


@pytest.mark.parametrize("slit", [0.2, 0.4, 0.8, 1.6])
def test_a_fork_opens_through_a_narrow_slit(tmp_path: Path, slit: float):
    """A fork opens as on cells of half the size, where slits of 0.8 or 1.6 need no copies.

    Each prong is a cantilever of length l and height b on a base that yields. Two beams give 2 F
    l^3 / (3 E I), the base adds up to a quarter. Joined, the prongs open by 0.1% of this. Multigrid
    must know the copies: coarse grids that join the prongs take four times the iterations.
    """
    path = pulled(tmp_path, fork(slit), *TIPS)
    found, products = opening(path)
    finer, _ = opening(path, "cages.cell_size=0.05")
    assert found == pytest.approx(finer, rel=0.05)
    length, b, depth = (LENGTH - BASE) * H, (WIDTH - slit) / 2 * H, DEPTH * H
    beams = 2 * 4 * FORCE * length**3 / (YOUNG * b**3 * depth)
    assert 1.0 < found / beams < 1.25
    assert products < 70


def test_a_fork_is_the_same_on_any_number_of_ranks(tmp_path: Path):
    path = pulled(tmp_path, fork(0.3, 0.2), *TIPS, solver={"error": 1e-8})
    one, three = (result_on(ranks, path) for ranks in (1, 3))
    with one, three:
        q = [run["frames/position"][1] for run in (one, three)]
        np.testing.assert_array_equal(one["lattice/cells"][:], three["lattice/cells"][:])
    np.testing.assert_allclose(q[0], q[1], atol=1e-8)


def test_two_free_forks_move_as_each_alone(tmp_path: Path):
    """Coarse copies follow the keys by which multigrid separates free bodies."""
    fork(0.3).export(tmp_path / "fork.ply")
    spin = {"velocity": [0.0, 0.0, 0.0], "spin": [0.0, 0.0, 4.0]}
    scene = {
        "cages": {"cell_size": H},
        "material": solid_of(YOUNG, 0.3),
        "time": {"step": 0.05, "duration": 0.1},
        "solver": {"preset": "newton-multigrid", "error": 1e-8},
        "output": {"surface": False},
    }  # fmt: skip
    bodies = [
        {"mesh": {"source": "fork.ply", "base": base}, "start": spin}
        for base in ([0, 0, 0], [0, 3, 0])
    ]
    ends = []
    for name, some in (("two", bodies), ("one", bodies[:1])):
        model, frames = play(write_scene(tmp_path, name, **scene, body=some))
        ends.append((frames[-1].position - model.lattice.nodes, len(model.lattice.mass)))
    (two, _), (one, nodes) = ends
    np.testing.assert_allclose(two[:nodes], one, atol=1e-7)
    np.testing.assert_allclose(two[nodes:], one, atol=1e-7)


def test_the_surface_drawn_follows_its_own_part(tmp_path: Path):
    """Triangles longer than a cell are divided; their new points also follow their own prong."""
    path = pulled(tmp_path, fork(0.4), *TIPS)
    with result_on(1, path) as run:
        name = run.filename
    subject = drawn(drawable_of_result(open_result(name)))
    assert len(subject.rest.points) > len(fork(0.4).vertices)
    points = subject.rest.points
    far = points[:, 0] > (BASE + 4) * H
    aside = (subject.embedding @ (subject.nodes(1) - subject.rest.nodes))[far, 1]
    np.testing.assert_array_equal(np.sign(aside), np.sign(points[far, 1] - WIDTH * H / 2))


def spiral(thickness: float, gap: float) -> tuple[trimesh.Trimesh, np.ndarray, float]:
    """Return a tilted sheet rolled up in 2.5 turns [cells], the middles of its ends, its length."""
    angle = np.linspace(0, 5 * np.pi, 161)
    along = np.stack([np.cos(angle), np.sin(angle)], 1)
    radius = 1.5 + (thickness + gap) * angle / (2 * np.pi)
    inner, outer = radius[:, None] * along, (radius + thickness)[:, None] * along
    middle = (inner + outer) / 2
    outline = np.concatenate([inner, outer[::-1]])
    rolled = manifold3d.CrossSection([outline], manifold3d.FillRule.NonZero).extrude(3).to_mesh()
    body = trimesh.Trimesh(rolled.vert_properties[:, :3], rolled.tri_verts)
    turned = trimesh.transformations.euler_matrix(0.4, 0.3, 0.2)
    ends = np.append(middle[[0, -1]], np.full((2, 1), 1.5), axis=1) @ turned[:3, :3].T
    body.apply_transform(turned)
    body.apply_scale(H)
    return body, ends * H, float(np.linalg.norm(np.diff(middle, axis=0), axis=1).sum())


@pytest.mark.parametrize(("thickness", "gap"), [(0.8, 0.1), (1.2, 0.2), (0.6, 0.4)])
def test_a_rolled_sheet_is_as_long_in_the_lattice(thickness: float, gap: float):
    """The shortest path along shared nodes is as long as the sheet; joined layers shorten it."""
    body, ends, length = spiral(thickness, gap)
    cages, net = cages_of(body)
    corners = csr_array(
        (np.ones(net.cells.size), net.cells.ravel(), np.arange(0, net.cells.size + 1, 8))
    )
    middles = cages.grids.node_positions(net.ijk)[net.cells[:, 0]] + H / 2
    near = [np.flatnonzero(np.linalg.norm(middles - end, axis=1) < 0.9 * H) for end in ends]
    steps = shortest_path(corners @ corners.T, unweighted=True, indices=near[0])[:, near[1]]
    # cells near an end may belong to the next layer, so the longest path counts
    assert np.isfinite(steps).all() and steps.max() > 0.85 * length / np.sqrt(3)


@pytest.mark.parametrize("gap", [0.1, 0.3])
def test_lips_part_along_an_arched_slit(tmp_path: Path, gap: float):
    """The opening agrees with finer cells within 10%.

    A slit of 1.6 cells gives 0.93, because the plate bends. The slit crosses rows of cells. In a
    grazed cell a sliver of the lower lip lies between all lines of the search. If it were joined
    with the upper lip, the lips would part by 0.05.
    """
    held, pulled_side = (
        {"half_space": {"point": [0, s * (4 * H - 1e-3), 0], "normal": [0, s, 0]}} for s in (-1, 1)
    )
    tables = {
        "pin": [{"region": held}],
        "force": [{"region": pulled_side, "total": [0.0, 40.0, 0.0]}],
    }
    path = pulled(tmp_path, lips(gap), [], [], **tables)

    def parted(*overrides: str) -> float:
        model, frames = play(path, *overrides)
        points = model.surface.points
        above = points[:, 1] - 1.2 * H * np.cos(points[:, 0] / (14 * H) * np.pi)
        near = (np.abs(points[:, 0]) < 3 * H) & (np.abs(above) < H)
        up = (frames[-1].surface - points)[:, 1]
        return float(up[near & (above > 0)].mean() - up[near & (above < 0)].mean())

    assert parted() == pytest.approx(parted("cages.cell_size=0.05"), rel=0.1)
