"""Lowest eigenvalues by locally optimal conjugate gradients on a block of directions (LOBPCG).

The method is Algorithm 5.1 of Knyazev 2001, Toward the optimal preconditioned eigensolver, with the
step's preconditioner. A block is needed since a single direction may settle on a higher mode.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Floats, Rows, greatest, like, to_host
from msmpetsc.solve.linear.operators import TrueHessian
from msmpetsc.solve.nonlinear.functional import StepFunctional
from msmpetsc.solve.nonlinear.preconditioning import StepPreconditioner

# Most iterations of a long search
LONGEST_SEARCH = 100
# A long search ends if the curvature is above this share of its value half as many
# iterations ago
SETTLED = 0.95
# A search ends if a negative curvature is above this multiple of its value two
# iterations ago
SHARPENED = 1.1
TINY = np.finfo(float).tiny
# Relative eigenvalue of a Gram matrix below which directions are linearly dependent
DEPENDENT = 1e-10

# Directions (k, n), their products with H, and their products with M or the projected
# Hessian
Block = tuple[Rows, ...]
Act = Callable[[None, PETSc.Vec, PETSc.Vec], None]


class SearchEffort(NamedTuple):
    """Effort of searches.

    block    : directions of a long search
    least    : fewest iterations of a long search
    followed : iterations of a short search, which has two directions
    """

    block: int
    least: int
    followed: int


EFFORT = SearchEffort(4, 12, 2)
# With multigrid smooth modes converge at once. After an alarm EFFORT is taken all the
# same: a folded body may hide its lowest mode.
UNIFORM_EFFORT = SearchEffort(2, 3, 1)


class Lobpcg:
    """Search for the lowest eigenvalues of W^(-1) H. All methods are collective.

    its : iterations, a direction each, of all searches so far
    """

    def __init__(
        self, functional: StepFunctional, hessian: TrueHessian, preconditioner: StepPreconditioner
    ):
        self.functional, self.hessian, self.preconditioner = functional, hessian, preconditioner
        self.comm, self.memory, self.its = functional.comm, functional.memory, 0
        self.vectors = [functional.unknowns.create_vector() for _ in range(2)]

    def random(self, count: int) -> Rows:
        """Return preconditioned noise (count, n), which does not depend on the number of ranks."""
        return self.unit(self._of_each(self.preconditioner.apply, self.functional.noise(count)))

    def lowest(
        self,
        start: Rows,
        block: int,
        most: int,
        least: int,
        weigh: Act | None = None,
        left_out: Rows | None = None,
    ) -> tuple[Floats, Rows]:
        """Return the lowest eigenvalues (k,), k <= block, of W^(-1) H and their modes (k, n).

        start    : directions (l, n)
        most     : most iterations
        least    : fewest iterations
        weigh    : applies W; M if None
        left_out : directions (r, n), orthonormal in M, that the search leaves out
        """
        lowest = []
        for its, found in enumerate(self.iterates(start, block, weigh, left_out)):
            lowest.append(found[0][0])
            if its == most:
                break
            if lowest[-1] < 0:
                if its >= 2 and lowest[-1] > SHARPENED * lowest[-3]:
                    break
            elif its >= max(least, 1) and lowest[-1] > SETTLED * lowest[its // 2]:
                break
        return found[0], found[1]

    def iterates(
        self, start: Rows, block: int, weigh: Act | None = None, left_out: Rows | None = None
    ) -> Iterator[tuple[Floats, Rows, Floats]]:
        """Yield the lowest eigenvalues (k,), their modes (k, n) and errors (k,), without end.

        The errors r^T P^-1 r of the eigenvalues are those before the last iteration, with the
        residuals r and the preconditioner P. Arguments are those of ``lowest``.
        """
        size = min(block, len(start))
        values, (x, last) = self._ritz(self._block(start, weigh), size)
        # A small body has fewer modes than the block
        size = len(values)
        errors = np.full(size, np.inf)
        while True:
            yield values, x[0], errors
            residuals = x[1] - like(start, values)[:, None] * x[2]
            sizes = np.array([greatest(np.abs(residual)) for residual in residuals])
            self.comm.Allreduce(MPI.IN_PLACE, sizes, MPI.MAX)
            # Multigrid works in single precision
            residuals /= like(residuals, np.maximum(sizes, TINY)[:, None])
            w = self._of_each(self.preconditioner.apply, residuals)
            errors = self.comm.allreduce(to_host((residuals * w).sum(axis=1))) * sizes**2
            w = self.unit(self.without(left_out, w))
            blocks = [x, self._block(w, weigh), *([] if last is None else [last])]
            values, (x, last) = self._ritz(
                tuple(np.concatenate(parts) for parts in zip(*blocks, strict=True)), size
            )
            self.its += len(w)

    def _block(self, directions: Rows, weigh: Act | None) -> Block:
        weighed = (
            directions * self.functional.mass if weigh is None else self._of_each(weigh, directions)
        )
        return directions, self._of_each(self.hessian.mult, directions), weighed

    def _ritz(self, block: Block, size: int) -> tuple[Floats, tuple[Block, Block | None]]:
        """Return the lowest Ritz values (size,) in the span of a block, ascending, and two blocks.

        The first block has the Ritz vectors, of unit length. The second block has the parts of
        the Ritz vectors outside the first ``size`` directions, the conjugate directions.
        """
        span, products, weighed = block
        grams = self.comm.allreduce(
            np.stack([to_host(span @ products.T), to_host(span @ weighed.T)])
        )
        lengths = np.sqrt(np.maximum(grams[1].diagonal(), TINY))
        grams = grams / lengths / lengths[:, None]
        sizes, parts = np.linalg.eigh(0.5 * (grams[1] + grams[1].T))
        kept = sizes > DEPENDENT * max(sizes[-1], TINY)
        parts = parts[:, kept] / np.sqrt(sizes[kept])
        values, turns = np.linalg.eigh(parts.T @ (0.5 * (grams[0] + grams[0].T)) @ parts)
        parts = (parts @ turns)[:, :size].T / lengths
        on_device = like(span, parts)
        best = tuple(on_device @ rows for rows in block)
        if len(span) <= size:
            return values[:size], (best, None)
        rest = like(span, parts[:, size:])
        return values[:size], (best, tuple(rest @ rows[size:] for rows in block))

    def without(self, left_out: Rows | None, directions: Rows) -> Rows:
        """Return directions (k, n) without their parts in directions ``left_out`` (r, n)."""
        if left_out is None:
            return directions
        parts = self.comm.allreduce(to_host((directions * self.functional.mass) @ left_out.T))
        return directions - like(directions, parts) @ left_out

    def _of_each(self, act: Act, directions: Rows) -> Rows:
        source, product = self.vectors
        results = np.empty_like(directions)
        for direction, result in zip(directions, results, strict=True):
            self.memory.write(source)[:] = direction
            act(None, source, product)
            result[:] = self.memory.read(product)
        return results

    def unit(self, directions: Rows) -> Rows:
        """Return directions scaled to unit length in the norm of M; zero directions stay zero."""
        squares: Floats = self.comm.allreduce(to_host(directions**2 @ self.functional.mass))
        lengths: Rows = like(directions, np.maximum(np.sqrt(squares), TINY))[:, None]
        return directions / lengths

    def destroy(self) -> None:
        """Destroy the PETSc vectors (collective)."""
        for vector in self.vectors:
            vector.destroy()
