"""Self-contact in multigrid's cycle: Woodbury's formula, and the steps that use it."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sparse
from block_scene import play, solid_of
from mpi4py import MPI
from pinch import pinch_scene

from msmpetsc.contact.surface.surface_contact import SurfaceHessian
from msmpetsc.solve.multigrid import cycle
from msmpetsc.solve.multigrid.contact import ContactSmoother, coarse_contact

POINTS, NODES, T2 = 7, 12, 1e-3


@pytest.fixture
def surface() -> SurfaceHessian:
    """Return three stiff pairs of points of five nodes each; the last pair is the stiffest."""
    rng = np.random.default_rng(5)
    weights = np.where(rng.random((POINTS, NODES)) < 0.4, rng.normal(size=(POINTS, NODES)), 0.0)
    points = np.zeros((3 * POINTS, 3 * POINTS))
    for stiffness, (a, b) in zip((1e3, 1e6, 1e12), ((0, 1), (2, 3), (5, 6)), strict=True):
        along = np.zeros((POINTS, 3))
        along[a] = rng.normal(size=3)
        along[b] = -along[a]
        points += stiffness * np.outer(along, along)
    return SurfaceHessian(MPI.COMM_SELF, sparse.csr_array(weights), sparse.csr_array(points))


def joined(surface: SurfaceHessian) -> np.ndarray:
    """Return C = t^2 W^T H_c W (3n, 3n), with the columns x, y, z of a node together."""
    w = np.kron(surface.weights.toarray(), np.eye(3))
    return T2 * w.T @ surface.points.toarray() @ w


def test_the_smoother_inverts_blocks_and_contact_together(surface: SurfaceHessian):
    """All eigenvalues are 1, although contact is 1e9 times as stiff as the blocks."""
    rng = np.random.default_rng(6)
    roots = rng.normal(size=(NODES, 3, 3))
    inverse = roots @ roots.transpose(0, 2, 1) + np.eye(3)
    d = np.zeros((NODES, 3, NODES, 3))
    d[np.arange(NODES), :, np.arange(NODES)] = np.linalg.inv(inverse)
    whole = np.linalg.cholesky(d.reshape(3 * NODES, -1) + joined(surface))
    unknowns = SimpleNamespace(comm=MPI.COMM_SELF, free=np.arange(NODES))
    smoother = ContactSmoother(unknowns, surface, T2, inverse.reshape(-1, 9))
    columns = []
    for x in np.eye(3 * NODES):
        y = np.einsum("nij,nj->in", inverse, x.reshape(-1, 3))
        smoother.correct(y)
        columns.append(y.T.ravel())
    eigenvalues = np.linalg.eigvals(whole.T @ np.array(columns) @ whole)
    np.testing.assert_allclose(eigenvalues, 1.0, atol=1e-4)


def test_the_stiff_points_and_the_others_are_the_whole_less_what_joins_both(
    surface: SurfaceHessian,
):
    """A point is stiff if its contact yields less than its nodes, as in the last pair."""
    compliance = np.full(NODES, 1e-8)
    stiff, others = surface.split(compliance, POINTS)
    assert stiff is not None and others is not None and stiff.points.shape == (6, 6)
    np.testing.assert_allclose(
        joined(stiff) + joined(others), joined(surface), atol=1e-12 * np.abs(joined(surface)).max()
    )
    assert np.abs(joined(stiff)).max() > 1e3 * np.abs(joined(others)).max()
    # only the stiffest contact
    one, rest = surface.split(compliance, 1)
    assert one.points.shape == (3, 3) and rest.points.shape == (18, 18)
    assert surface.split(1e-12 * compliance, POINTS)[0] is None


def test_the_coarsest_level_has_the_whole_contact_and_finer_levels_their_blocks(
    surface: SurfaceHessian,
):
    """Contact equals P^T C P by dense products."""
    rng = np.random.default_rng(7)
    p = [rng.random((NODES, 6)), rng.random((6, 4))]
    interpolations = [
        SimpleNamespace(rows=lambda p=p: sparse.csr_array(p), first=0, own=p.shape[1]) for p in p
    ]
    between = np.zeros((6, 9))
    contact = coarse_contact(surface.weights, surface, interpolations, T2, [between])
    first, second = (np.kron(whole, np.eye(3)) for whole in (p[0], p[0] @ p[1]))
    expected = first.T @ joined(surface) @ first
    blocks = expected.reshape(6, 3, 6, 3)[np.arange(6), :, np.arange(6)].reshape(6, 9)
    np.testing.assert_allclose(between, blocks, rtol=1e-10)
    expected = second.T @ joined(surface) @ second
    np.testing.assert_allclose(contact.toarray(), expected, rtol=1e-10)


SOLID = solid_of(1e5)


def test_contact_that_joins_nodes_takes_a_part_of_the_iterations_to_the_same_frames(
    tmp_path: Path, monkeypatch
):
    """With joined nodes the second step in contact takes fewer iterations to 1e-12.

    The first step joins no nodes, and the third ends in either of two minima. Rounding changes the
    counts by a tenth, so they are summed over three moduli.
    """
    its = {0: 0, cycle.POINTS: 0}
    for change in (0, 1e-13, -1e-13):
        positions = []
        material = SOLID | {"young_modulus": 1e5 * (1 + change)}
        tables = {"material": material, "time": {"step": 0.0015, "duration": 0.0675}}
        for most in its:
            monkeypatch.setattr(cycle, "POINTS", most)
            solver = {"preset": "newton-multigrid", "error": 1e-12}
            _, frames = play(pinch_scene(tmp_path, solver=solver, **tables))
            touching = [frame for frame in frames if frame.self_contacts > 0]
            assert len(touching) == 2
            its[most] += touching[1].ksp_its
            positions.append(frames[-1].position)
        np.testing.assert_allclose(positions[1], positions[0], atol=1e-9 * np.ptp(positions[0]))
    without, joined_nodes = its.values()
    # 400 of 555
    assert joined_nodes < 0.85 * without
