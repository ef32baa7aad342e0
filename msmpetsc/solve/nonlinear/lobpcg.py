"""Lowest eigenvalues of M^(-1) H by locally optimal conjugate gradients (LOBPCG).

The method is Algorithm 5.1 of Knyazev 2001, Toward the optimal preconditioned eigensolver, with the
step's preconditioner. A block of directions is needed, since a single direction may converge to a
higher mode.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Floats, Rows, greatest, like, to_host
from msmpetsc.comm import reduced
from msmpetsc.solve.linear.operators import TrueHessian
from msmpetsc.solve.nonlinear.functional import StepFunctional
from msmpetsc.solve.nonlinear.preconditioning import StepPreconditioner

# Greatest number of iterations of a long search
LONGEST_SEARCH = 100
# Relative change of an eigenvalue that counts as none [-]. A long search ends after
# twice the iterations without a change; a mode without a change is not searched again.
UNCHANGED = 0.1
TINY = np.finfo(float).tiny
# Relative eigenvalue of a Gram matrix below which directions are linearly dependent [-]
DEPENDENT = 1e-10

# Number of unknowns in a chunk of directions; bounds the memory of combinations
CHUNK = 1 << 16

Act = Callable[[None, PETSc.Vec, PETSc.Vec], None]


class SearchEffort(NamedTuple):
    """Effort of searches.

    block    : number of directions of a long search
    least    : least number of iterations of a long search
    followed : number of iterations of a short search, which has two directions
    """

    block: int
    least: int
    followed: int


EFFORT = SearchEffort(4, 12, 2)
# Effort with multigrid, with which smooth modes converge at once. After an alarm EFFORT
# is still taken, because a folded body may hide its lowest mode.
UNIFORM_EFFORT = SearchEffort(2, 3, 1)


@dataclass
class SearchSpace:
    """Directions of a search and their products with H, which iterations change in place.

    directions : (room, n), the first ``used`` rows are in use
    products   : (room, n) products of the directions with H
    """

    directions: Rows
    products: Rows
    used: int

    def _chunks(self) -> Iterator[slice]:
        """Return an iterator over the unknowns in chunks."""
        count = self.directions.shape[1]
        return (slice(at, at + CHUNK) for at in range(0, count, CHUNK))

    def grams(self, mass: Floats) -> Rows:
        """Return this rank's part of the directions' Gram matrices in H and M (2, used, used)."""
        sums = np.zeros((2, self.used, self.used))
        rows = slice(self.used)
        for chunk in self._chunks():
            span = self.directions[rows, chunk]
            sums[0] += to_host(span @ self.products[rows, chunk].T)
            sums[1] += to_host((span * mass[chunk]) @ span.T)
        return sums

    def combine(self, parts: Rows) -> None:
        """Replace the directions by combinations of them, with coefficients ``parts`` (k, used)."""
        count, on_device = len(parts), like(self.directions, parts)
        for rows in (self.directions, self.products):
            for chunk in self._chunks():
                rows[:count, chunk] = on_device @ rows[: self.used, chunk]
        self.used = count


class Lobpcg:
    """Search for the lowest eigenvalues of M^(-1) H. All methods are collective.

    its : number of new directions in all searches so far; an iteration adds one for each mode
    """

    def __init__(
        self, functional: StepFunctional, hessian: TrueHessian, preconditioner: StepPreconditioner
    ):
        self.functional, self.hessian, self.preconditioner = functional, hessian, preconditioner
        self.comm, self.memory, self.its = functional.comm, functional.memory, 0

    def random(self, count: int) -> Rows:
        """Return preconditioned noise (count, n), which does not depend on the number of ranks."""
        noise = self.functional.noise(count)
        self._of_each(self.preconditioner.apply, noise, noise)
        return self.unit(noise)

    def curvature(self, direction: Floats) -> float:
        """Return the curvature v^T H v along a direction v (n,) of unit length in the norm of M."""
        product = np.empty_like(direction)
        self._of_each(self.hessian.mult, direction[None], product[None])
        return float(reduced(self.comm, float(direction @ product)))

    def lowest(
        self,
        start: list[Rows],
        block: int,
        most: int,
        least: int,
        left_out: Rows | None = None,
    ) -> tuple[Floats, Rows]:
        """Return the lowest eigenvalues (k,), k <= block, of M^(-1) H and their modes (k, n).

        start    : directions (l, n) in parts, which the search takes out of the list
        block    : number of modes to search
        most     : greatest number of iterations
        least    : least number of iterations
        left_out : directions (r, n), orthonormal in M, that the search leaves out
        """
        lowest = []
        for its, ritz in enumerate(self.iterates(start, block, left_out)):
            lowest.append(ritz[0][0])
            if its == most:
                break
            least_its = 2 if lowest[-1] < 0 else max(least, 1)
            fall = lowest[its // 2] - lowest[-1]
            # The eigenvalue may be infinite or NaN
            if its >= least_its and not fall > UNCHANGED * abs(lowest[-1]):
                break
        return ritz[0], ritz[1].copy()

    def iterates(
        self, start: list[Rows], block: int, left_out: Rows | None = None
    ) -> Iterator[tuple[Floats, Rows, Floats]]:
        """Yield the lowest eigenvalues (k,), their modes (k, n) and errors (k,), without end.

        The errors r^T P^-1 r, with residuals r and the preconditioner P, belong to the eigenvalues
        before the last iteration. The next iteration overwrites the modes. The arguments are
        described in ``lowest``.
        """
        space = self._space(start, block)
        values = self._ritz(space, min(block, space.used))
        # A small body has fewer modes than the block
        size = len(values)
        errors = np.full(size, np.inf)
        while True:
            yield values, space.directions[:size], errors
            errors = np.array([self._add_residual(space, i, values[i]) for i in range(size)])
            added = space.directions[space.used - size : space.used]
            added[:] = self.unit(self.without(left_out, added))
            self._multiply(space, space.used - size)
            values = self._ritz(space, size)
            self.its += size

    def _space(self, start: list[Rows], block: int) -> SearchSpace:
        """Return the space of directions, with room for the directions of an iteration.

        start : directions (l, n) in parts, taken out of the list to free their memory
        """
        mass = self.functional.mass
        room = max(sum(map(len, start)), 3 * block), len(mass)
        space = SearchSpace(np.empty(room, like=mass), np.empty(room, like=mass), 0)
        while start:
            part = start.pop(0)
            space.directions[space.used : space.used + len(part)] = part
            space.used += len(part)
        self._multiply(space, 0)
        return space

    def _multiply(self, space: SearchSpace, first: int) -> None:
        """Compute the products of H with the directions from the number ``first`` on."""
        new = slice(first, space.used)
        self._of_each(self.hessian.mult, space.directions[new], space.products[new])

    def _add_residual(self, space: SearchSpace, i: int, value: float) -> float:
        """Add the preconditioned residual of the i-th Ritz vector; return its error r^T P^-1 r."""
        residual = space.products[i] - value * self.functional.mass * space.directions[i]
        scale = max(reduced(self.comm, float(greatest(np.abs(residual))), MPI.MAX), TINY)
        # Multigrid works in single precision
        residual /= scale
        w = space.directions[space.used]
        self._of_each(self.preconditioner.apply, residual[None], w[None])
        space.used += 1
        error: float = reduced(self.comm, float(residual @ w)) * scale**2
        return error

    def _ritz(self, space: SearchSpace, size: int) -> Floats:
        """Return the lowest Ritz values (size,) in a space, ascending, and reduce the space.

        The reduced space has the Ritz vectors, of unit length, then the conjugate directions. These
        are the parts of the Ritz vectors outside the first ``size`` directions.
        """
        grams = reduced(self.comm, space.grams(self.functional.mass))
        lengths = np.sqrt(np.maximum(grams[1].diagonal(), TINY))
        grams = grams / lengths / lengths[:, None]
        sizes, parts = np.linalg.eigh(0.5 * (grams[1] + grams[1].T))
        kept = sizes > DEPENDENT * max(sizes[-1], TINY)
        parts = parts[:, kept] / np.sqrt(sizes[kept])
        values, turns = np.linalg.eigh(parts.T @ (0.5 * (grams[0] + grams[0].T)) @ parts)
        parts = (parts @ turns)[:, :size].T / lengths
        rest = parts.copy() if space.used > size else parts[:0]
        rest[:, :size] = 0.0
        space.combine(np.concatenate([parts, rest]))
        return values[:size]

    def without(self, left_out: Rows | None, directions: Rows) -> Rows:
        """Return directions (k, n) without their parts in directions ``left_out`` (r, n)."""
        if left_out is None:
            return directions
        parts = reduced(self.comm, to_host((directions * self.functional.mass) @ left_out.T))
        return directions - like(directions, parts) @ left_out

    def _of_each(self, act: Act, directions: Rows, results: Rows) -> None:
        """Write an operator's products with ``directions`` (k, n) to ``results`` (k, n).

        Both may be the same array.
        """
        vectors = self.functional.vectors
        source, product = vectors.take(), vectors.take()
        for direction, result in zip(directions, results, strict=True):
            self.memory.write(source)[:] = direction
            act(None, source, product)
            result[:] = self.memory.read(product)
        vectors.give_back(source)
        vectors.give_back(product)

    def unit(self, directions: Rows) -> Rows:
        """Return directions scaled to unit length in the norm of M; zero directions stay zero."""
        squares: Floats = reduced(self.comm, to_host(directions**2 @ self.functional.mass))
        lengths: Rows = like(directions, np.maximum(np.sqrt(squares), TINY))[:, None]
        return directions / lengths
