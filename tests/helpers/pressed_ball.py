"""A ball pressed by a rigid plate, by lattices and by quadratic finite elements of its section.

Run as a script it prints the forces in `scripts/results/contact.md`.
"""

from typing import Any

import lab

import numpy as np
import skfem
import trimesh
from scipy.sparse.linalg import spsolve
from solid_runs import held, run

# Young's modulus [Pa], Poisson's ratio, Lame's parameters [Pa]; the radius is 1 m
E, NU = 1e6, 0.3
MU, LAMBDA = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
# change [m] that ends Newton's method; most iterations, and most changes of the contact
SMALL, MOST = 1e-9, 60
# depth of the plate, and gap before a barrier's plate [m]
DEPTH, GAP = 0.02, 0.005
# force [N] at DEPTH by the section's finite elements
ELEMENTS = 4387.0


def hertz(depth: float) -> float:
    """Return Hertz's force [N] of a plate pressed in by a depth [m]."""
    return 4 / 3 * E / (1 - NU**2) * depth**1.5


def section(depth: float, edge: float) -> skfem.MeshTri:
    """Return a quarter of the disc x² + y² ≤ 1, with edges [m] of ``edge`` around (0, 1)."""
    sides, size = [0.0], edge
    while sides[-1] < np.pi / 2:
        sides.append(sides[-1] + size)
        size = size if sides[-1] < 1.6 * np.sqrt(depth) else min(1.2 * size, 0.1)
    square = np.array(sides) / sides[-1]
    mesh = skfem.MeshTri.init_tensor(square, square)
    angle, share = mesh.p[0] * np.pi / 2, 1 - mesh.p[1]
    points = np.array([np.sin(angle), np.cos(angle) * share])
    # the columns at the equator have no height
    a, b, c = points[:, mesh.t].transpose(1, 0, 2)
    area = (b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0]
    return skfem.MeshTri(points, mesh.t[:, np.abs(area) > 1e-10])


def _deformation(grad, radial, radius):
    """Return F_rr, F_rz, F_zr, F_zz, the hoop stretch, and the minors for dJ / dF."""
    a, b, c, d = 1 + grad[0, 0], grad[0, 1], grad[1, 0], 1 + grad[1, 1]
    around = 1 + radial / radius
    minors = d * around, -c * around, -b * around, a * around, a * d - b * c
    return (a, b, c, d, around), minors


def _rates(v, radius):
    """Return the derivatives of the five entries of F by a displacement."""
    return v.grad[0, 0], v.grad[0, 1], v.grad[1, 0], v.grad[1, 1], v[0] / radius


@skfem.LinearForm
def _force(v, w):
    F, minors = _deformation(w["u"].grad, w["u"][0], w.x[0])
    J = minors[4] * F[4]
    slope = -MU / J + LAMBDA * (J - 1)
    terms = zip(F, minors, _rates(v, w.x[0]), strict=True)
    return 2 * np.pi * w.x[0] * sum((MU * f + slope * c) * g for f, c, g in terms)


@skfem.BilinearForm
def _stiffness(u, v, w):
    F, minors = _deformation(w["u"].grad, w["u"][0], w.x[0])
    J = minors[4] * F[4]
    slope, curvature = -MU / J + LAMBDA * (J - 1), MU / J**2 + LAMBDA
    a, b, c, d, around = F
    p, q, r, s, t = rates = _rates(u, w.x[0])
    change = sum(m * g for m, g in zip(minors, rates, strict=True))
    turned = (
        s * around + d * t,
        -r * around - c * t,
        -q * around - b * t,
        p * around + a * t,
        p * d + a * s - q * c - b * r,
    )
    terms = zip(rates, minors, turned, _rates(v, w.x[0]), strict=True)
    return (
        2
        * np.pi
        * w.x[0]
        * sum((MU * g + curvature * change * m + slope * n) * h for g, m, n, h in terms)
    )


def force(depth: float, edge: float, loads: int = 2) -> float:
    """Return the force [N] of a frictionless plate pressed in by a depth [m].

    Surface nodes that would cross the plate are fixed to it, and released if it would pull them.
    """
    mesh = section(depth, edge)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTriP2()), intorder=5)
    rest, upright = basis.doflocs, np.zeros(basis.N, bool)
    for numbers in (basis.nodal_dofs[1], basis.facet_dofs[1]):
        upright[numbers] = True
    used = np.isin(np.arange(basis.N), basis.element_dofs)
    symmetric = (~upright & (rest[0] < 1e-9)) | (upright & (rest[1] < 1e-9))
    round_facets = mesh.facets_satisfying(lambda x: (x > 1e-6).all(axis=0), boundaries_only=True)
    surface = np.zeros(basis.N, bool)
    surface[basis.get_dofs(round_facets).flatten()] = True
    surface &= upright
    u, held = np.zeros(basis.N), np.zeros(basis.N, bool)
    push = np.zeros(basis.N)
    for plate in 1 - depth * np.linspace(0, 1, loads + 1)[1:]:
        for _ in range(MOST):
            free = used & ~symmetric & ~held
            for _ in range(MOST):
                K = _stiffness.assemble(basis, u=basis.interpolate(u))
                step = np.where(held, plate - rest[1] - u, 0.0)
                right = -(_force.assemble(basis, u=basis.interpolate(u)) + K @ step)
                step[free] = spsolve(K[free][:, free].tocsc(), right[free])
                u += step
                if np.abs(step).max() < SMALL:
                    break
            push = -_force.assemble(basis, u=basis.interpolate(u))
            pulled = held & (push < 0)
            crossed = surface & ~held & (rest[1] + u > plate + 1e-12)
            if not (pulled | crossed).any():
                break
            held = (held & ~pulled) | crossed
    return float(push[held].sum())


def octant(edge: float) -> trimesh.Trimesh:
    """Return an octant of the ball with edges [m] of ``edge`` within 0.22 m of (0, 0, 1)."""
    angle, size = 0.0, edge
    points = [np.eye(3)[2:]]
    while angle < np.pi / 2:
        size = edge if angle < 0.22 else min(1.2 * size, 0.1)
        angle += 0.87 * size
        if angle > np.pi / 2 - size / 2:
            angle = np.pi / 2
        around = np.linspace(0, np.pi / 2, max(2, round(np.sin(angle) * np.pi / 2 / size) + 1))
        ring = np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around)
        points.append(np.column_stack([*ring, np.full(len(around), np.cos(angle))]))
    every = np.concatenate([*points, np.zeros((1, 3))])
    every[np.abs(every) < 1e-12] = 0
    return trimesh.convex.convex_hull(every)


def lattice_force(cells: int, mesh: trimesh.Trimesh, response: str, **contact: Any) -> float:
    """Return the force [N] of a plate on a lattice with ``cells`` cells per radius.

    contact : ``stiffness`` of the penalty, or ``distance`` of the barrier
    """
    sides: dict[str, Any] = {
        "cages": {"cell_size": 1 / cells},
        "pin": [held(axis, 0, -1) | {"fix": ["xyz"[axis]]} for axis in range(3)],
        "solver": {"error": 1e-5},
    }
    if response == "penalty":
        path = [{"time": 1, "by": [0, 0, -DEPTH]}]
        plate = {"shape": "plane", "point": [0, 0, 1], "normal": [0, 0, -1], "path": path}
        time = {"integrator": "static", "step": 1, "duration": 1}
        tables = {"obstacle": [plate | {"response": response} | contact], "time": time}
    else:
        path = [{"time": 1, "by": [0, 0, -DEPTH - GAP]}]
        plate = {"shape": "box", "box": [[-0.5, -0.5, 1 + GAP], [1.5, 1.5, 1.5]], "path": path}
        # light, and pressed slowly, so that the ball is at rest at the end
        tables = {
            "obstacle": [plate | {"response": response}],
            "self_contact": contact,
            "time": {"integrator": "implicit-euler", "step": 0.1, "duration": 1.5},
            "material": {"density": 1},
        }
    push = run(mesh, NU, **sides, **tables).frames[-1].push
    assert push is not None
    return 4 * abs(push[0, 2])


def row(name: str, value: float) -> None:
    """Print a force [N] against the finite elements and against Hertz."""
    errors = value / ELEMENTS - 1, value / hertz(DEPTH) - 1
    print(f"{name}: {value:.0f} N, {errors[0]:+.1%} of the elements ({errors[1]:+.1%})", flush=True)


if __name__ == "__main__":
    for pressed, size in ((2e-4, 1e-3), (DEPTH, 0.02), (DEPTH, 0.01), (DEPTH, 0.005)):
        ratio = force(pressed, size) / hertz(pressed)
        print(f"pressed in by {pressed} m, edges of {size} m: {100 * (ratio - 1):+.2f}% of Hertz")
    scene = trimesh.load(lab.SCENES / "studies" / "yardstick" / "ball_octant.obj", process=False)
    for cells in (8, 16, 32):
        row(f"penalty, {cells} cells", lattice_force(cells, scene, "penalty"))
    for cells in (16, 32):
        stiff = lattice_force(cells, scene, "penalty", stiffness=2e7)
        row(f"penalty of 2e7 N/m, {cells} cells", stiff)
    for cells, edge in (
        (8, 0.05),
        (16, 0.05),
        (16, 0.025),
        (16, 0.0125),
        (32, 0.025),
        (32, 0.0125),
    ):
        thin = lattice_force(cells, octant(edge), "barrier", distance=2e-4)
        row(f"barrier, {cells} cells, edges of {edge} m", thin)
    for cells, edge in ((8, 0.05), (16, 0.025), (32, 0.0125)):
        for share in (24, 64):
            wide = lattice_force(cells, octant(edge), "barrier", distance=1 / cells / share)
            row(f"barrier of 1/{share} of a cell, {cells} cells, edges of {edge} m", wide)
