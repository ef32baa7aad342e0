"""Algebra of vectors (3,), and of 3 x 3 matrices stored as three columns, inside kernels."""

from typing import TypeAlias

from msmpetsc.backend.arrays import Positions
from msmpetsc.backend.kernel import njit

Vector: TypeAlias = tuple[float, float, float]
# columns of a matrix, or vectors of the modes XY, XZ and YZ
Three: TypeAlias = tuple[Vector, Vector, Vector]


@njit(inline="always")
def vector(q: Positions, a: int, b: int) -> Vector:
    """Return the vector q_b - q_a from node a to node b."""
    return q[b, 0] - q[a, 0], q[b, 1] - q[a, 1], q[b, 2] - q[a, 2]


@njit(inline="always")
def dot(a: Vector, b: Vector) -> float:
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(inline="always")
def cross(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(inline="always")
def scaled(a: float, x: Vector) -> Vector:
    """Return a x."""
    return a * x[0], a * x[1], a * x[2]


@njit(inline="always")
def added(x: Vector, y: Vector) -> Vector:
    """Return x + y."""
    return x[0] + y[0], x[1] + y[1], x[2] + y[2]


@njit(inline="always")
def total(x: Three, y: Three) -> Three:
    """Return the sum of two matrices."""
    return added(x[0], y[0]), added(x[1], y[1]), added(x[2], y[2])


@njit(inline="always")
def times(a: float, x: Three) -> Three:
    """Return a number times a matrix."""
    return scaled(a, x[0]), scaled(a, x[1]), scaled(a, x[2])


@njit(inline="always")
def combined(t: Vector, x: Three) -> Vector:
    """Return the sum of t_i x_i: the product of the matrix with columns x and the vector t."""
    a, b, c = t
    f, g, h = x
    return (
        a * f[0] + b * g[0] + c * h[0],
        a * f[1] + b * g[1] + c * h[1],
        a * f[2] + b * g[2] + c * h[2],
    )


@njit(inline="always")
def each(t: Three, x: Three) -> Three:
    """Return the sums of t_i,j x_j for each i."""
    return combined(t[0], x), combined(t[1], x), combined(t[2], x)


@njit(inline="always")
def transposed(t: Three) -> Three:
    """Return the transpose of a matrix."""
    x, y, z = t
    return (x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2])


@njit(inline="always")
def inner(x: Three, y: Three) -> float:
    """Return the sum of x_i . y_i over i."""
    return dot(x[0], y[0]) + dot(x[1], y[1]) + dot(x[2], y[2])


@njit(inline="always")
def products(x: Three, y: Three) -> Three:
    """Return x_i . y_j for each i and j."""
    return (
        (dot(x[0], y[0]), dot(x[0], y[1]), dot(x[0], y[2])),
        (dot(x[1], y[0]), dot(x[1], y[1]), dot(x[1], y[2])),
        (dot(x[2], y[0]), dot(x[2], y[1]), dot(x[2], y[2])),
    )


@njit(inline="always")
def cofactors(f: Three) -> Three:
    """Return the cofactors of a matrix."""
    x, y, z = f
    return cross(y, z), cross(z, x), cross(x, y)


@njit(inline="always")
def change_of_cofactors(f: Three, g: Three) -> Three:
    """Return F x G, the derivative of cof F in the direction G."""
    x, y, z = f
    u, v, w = g
    return (
        added(cross(y, w), cross(v, z)),
        added(cross(z, u), cross(w, x)),
        added(cross(x, v), cross(u, y)),
    )
