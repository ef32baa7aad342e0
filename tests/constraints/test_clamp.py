"""Cells of a solid that a clamp cuts become stiffer, and so do the springs of A."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import CELL, YOUNG, clamped_beam, half_space, model_of, solid_of

from msmpetsc.elasticity.energy import Elasticity


@pytest.mark.parametrize("free", [0.5, 0.1])
def test_springs_of_a_solid_bound_its_hessian_at_a_clamp(tmp_path: Path, free: float):
    """The bound holds for all displacements if the clamp leaves a share of the first cells free."""
    pin = {"region": half_space(0, (1 - free) * CELL)}
    given = {"material": solid_of(YOUNG), "pin": [pin], "time": {"step": 0.01, "duration": 0.1}}
    scene = clamped_beam(tmp_path, **given)
    lattice = model_of(scene).lattice.with_springs()
    moving = np.flatnonzero(~lattice.pinned)
    laplacian = np.zeros((len(lattice.nodes),) * 2)
    for (a, b), k in zip(lattice.springs, lattice.stiffness, strict=True):
        laplacian[[a, b, a, b], [a, b, b, a]] += [k, k, -k, -k]
    hessian = Elasticity(lattice).hessian_at(lattice.nodes, projected=False)
    columns = []
    for node in moving:
        for axis in range(3):
            v, product = np.zeros((2, *lattice.nodes.shape))
            v[node, axis] = 1
            hessian.add_product(v, product)
            columns.append(product[moving].ravel())
    bound = np.kron(laplacian[np.ix_(moving, moving)], np.eye(3))
    eigenvalues = np.linalg.eigvalsh(bound - np.array(columns))
    assert eigenvalues[0] > -1e-9 * eigenvalues[-1]
