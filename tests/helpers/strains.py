"""Uniform strains of a lattice at rest, and their energy in a solid of Poisson's ratio 1/4."""

from collections.abc import Iterator

import numpy as np
from small_strain import DENSITY, E, hessian

from msmpetsc.lattice.lattice import Lattice

# [Pa]
C11, C12, C44 = 6 / 5 * E, 2 / 5 * E, 2 / 5 * E


def elastic_constant(lattice: Lattice, G: np.ndarray, other: np.ndarray) -> float:
    """Return u^T H v / volume [Pa] for u = G x and v = other x; G and other are (3, 3)."""
    u, v = ((lattice.nodes @ gradient.T).ravel() for gradient in (G, other))
    return u @ (hessian(lattice) @ v) * DENSITY / lattice.mass.sum()


def uniform_strains() -> Iterator[tuple[str, np.ndarray, np.ndarray, float]]:
    """Return names, two displacement gradients, and u^T H v / volume [Pa] of the solid."""
    x, y, z = np.eye(3)
    yield "C11: stretch along an edge", np.outer(x, x), np.outer(x, x), C11
    yield "C12: stretch along one edge against another", np.outer(x, x), np.outer(y, y), C12
    yield "C44: shear", np.outer(x, y), np.outer(x, y), C44
    turned = {
        "(1,1,0)": (x + y, z),
        "(1,1,1)": (x + y + z, x - y),
        "(3,2,6)": (3 * x + 2 * y + 6 * z, 2 * x - 3 * y),
    }
    for name, pair in turned.items():
        d, across = (direction / np.linalg.norm(direction) for direction in pair)
        yield f"C11 along {name}", np.outer(d, d), np.outer(d, d), C11
        yield f"C12 along {name}", np.outer(d, d), np.outer(across, across), C12
        yield f"C44 along {name}", np.outer(d, across), np.outer(d, across), C44
