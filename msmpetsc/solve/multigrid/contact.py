"""Contact of the surface with itself in multigrid's cycle, where it joins nodes of the finest and coarsest levels.

A pair that presses is stiff along one direction of some forty unknowns, and bodies that lie on each other move as one.
Diagonal blocks tell CG neither: they hold each node to the ground.
"""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpstrf
from scipy.sparse import csr_array, eye_array, kron

from msmpetsc.backend.arrays import Array, Rows
from msmpetsc.contact.surface.term import SurfaceHessian
from msmpetsc.solve.linear.unknowns import Unknowns

SPARE = 2.0  # times the nonzeros of the present contact: more room than that is not kept


class ContactSmoother:
    """Smoother of the finest level where contact of the surface with itself joins nodes, C = t^2 W^T H_c W.

    It inverts D + C, D the block diagonal without that contact, by Woodbury's formula on the points in contact,

        (D + C)^-1 = D^-1 - D^-1 W^T B (I + B^T G B)^-1 B^T W D^-1,    t^2 H_c = B B^T,    G = W D^-1 W^T.

    With B from Cholesky's factorisation, pivoted, a direction 1e9 times as stiff as D keeps seven digits.
    Where H - C is no more than b D, H is no more than b (D + C) for b >= 1, so that Chebyshev's bound
    stays.

    inverse : D^-1 (m, 9) of the free nodes [1/kg]
    nodes   : (c,) of these that carry the points; ``weights`` (k, c) by which, of k points
    middle  : (3k, 3k) between W and W^T
    """

    def __init__(self, unknowns: Unknowns, surface: SurfaceHessian, t2: float, inverse: Array):
        self.comm = unknowns.comm
        weights = surface.weights[:, unknowns.free]
        self.nodes = np.unique(weights.indices)
        self.weights, self.inverse = (
            csr_array(weights[:, self.nodes]),
            inverse[self.nodes].reshape(-1, 3, 3),
        )
        self.back = csr_array(self.weights.T)
        size = surface.points.shape[0]
        compliance, scaled = np.zeros((size, size)), self.weights.copy()
        for r in range(3):
            for c in range(3):
                scaled.data = self.weights.data * self.inverse[self.weights.indices, r, c]
                compliance[r::3, c::3] = (self.weights @ scaled.T).toarray()
        compliance = self.comm.allreduce(compliance)
        root = root_of(t2 * surface.points.toarray())
        lower = np.linalg.cholesky(np.eye(root.shape[1]) + root.T @ compliance @ root)
        root = solve_triangular(lower, root.T, lower=True, check_finite=False)
        self.middle = root.T @ root

    def correct(self, y: Rows) -> None:
        """Turn y = D^-1 x (3, m) into (D + C)^-1 x."""
        moved = self.weights @ y[:, self.nodes].T
        if self.comm.size > 1:
            moved = self.comm.allreduce(moved)
        back = self.back @ (self.middle @ moved.ravel()).reshape(-1, 3)
        y[:, self.nodes] -= np.einsum("mrc,mc->rm", self.inverse, back)


def root_of(matrix: Rows) -> Rows:
    """Return B (n, r) with B B^T a positive semidefinite matrix (n, n) of rank r, by pivoted Cholesky."""
    lower, pivots, rank, _ = dpstrf(matrix, lower=1)
    root = np.zeros((len(matrix), rank))
    root[pivots - 1] = np.tril(lower)[:, :rank]
    return root


class CoarseContact:
    """Contact C = t^2 (W P)^T H_c (W P) on coarse levels. All methods are collective.

    The coarsest matrix has all of it, the levels between its diagonal blocks, so that they keep their nonzeros. The
    coarsest has nonzeros for the contact of before as well, as long as these are few: with the same ones PETSc
    analyses it no more before it factors it, which takes longer than the factor.

    interpolations : P to each next finer level, of vectors
    """

    def __init__(self, unknowns: Unknowns, interpolations: list[PETSc.Mat], t2: float):
        self.unknowns, self.interpolations, self.t2 = unknowns, interpolations, t2
        self.scalar: list[
            csr_array
        ] = []  # P of one coordinate, this rank's rows; until there is contact
        self.coarsest: PETSc.Mat | None = None  # with contact
        self.nonzeros = csr_array((0, 0))  # ones where this rank's rows of it have room for contact

    def added(self, matrices: list[PETSc.Mat], surface: SurfaceHessian | None) -> PETSc.Mat:
        """Add contact to the matrices of all coarse levels but the last; the last one with contact."""
        if surface is None:
            return matrices[-1]
        self.scalar = self.scalar or self._scalar()
        weights = surface.weights[:, self.unknowns.free]
        for matrix, p in zip(matrices, self.scalar, strict=True):
            whole = sum(
                surface.comm.allgather(weights @ p)
            )  # in the order of the ranks: the same sum each time
            first, last = (bound // 3 for bound in matrix.getOwnershipRange())
            weights = csr_array(whole[:, first:last])
            if matrix is not matrices[-1]:
                own = SurfaceHessian(surface.comm, weights, surface.points)
                add_diagonal(matrix, self.t2 * own.blocks)
        joined = kron(weights, eye_array(3), "csr").T @ (
            surface.points @ kron(whole, eye_array(3), "csr")
        )
        return self._coarsest(matrices[-1], csr_array(joined))

    def _coarsest(self, without: PETSc.Mat, contact: csr_array) -> PETSc.Mat:
        """Return the coarsest matrix with this rank's rows of contact [kg], itself as it is ``without``."""
        here = csr_array(
            (np.ones_like(contact.data), contact.indices, contact.indptr), contact.shape
        )
        room = self.nonzeros + here if self.coarsest else here
        if self.coarsest is None or without.comm.tompi4py().allreduce(
            room.nnz > self.nonzeros.nnz, MPI.LOR
        ):
            self.destroy()
            self.nonzeros = room if room.nnz < SPARE * here.nnz else here
            self.coarsest = without.copy()
            self._add(
                aij(0.0 * self.nonzeros, without), PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN
            )
        self.coarsest.zeroEntries()
        self.coarsest.axpy(1.0, without, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        self._add(aij(self.t2 * contact, without), PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        return self.coarsest

    def _add(self, contact: PETSc.Mat, nonzeros: PETSc.Mat.Structure) -> None:
        assert self.coarsest is not None
        self.coarsest.axpy(1.0, contact, nonzeros)
        contact.destroy()

    def _scalar(self) -> list[csr_array]:
        """P of one coordinate of each level: of the finest rows of x come first, then of y and z."""
        found: list[csr_array] = []
        for p in self.interpolations:
            begin, columns, values = p.getValuesCSR()
            whole = csr_array((values, columns, begin), shape=(len(begin) - 1, p.getSize()[1]))
            rows = slice(self.unknowns.size) if not found else slice(None, None, 3)
            found.append(csr_array(csr_array(whole[rows])[:, ::3]))
        return found

    def destroy(self) -> None:
        if self.coarsest:
            self.coarsest.destroy()
            self.coarsest = None


def add_diagonal(matrix: PETSc.Mat, blocks: Rows) -> None:
    """Add 3 x 3 blocks (n, 9) to the diagonal of a matrix whose rows are this rank's."""
    first, last = (bound // 3 for bound in matrix.getOwnershipRange())
    begin, columns = (
        np.arange(len(blocks) + 1, dtype=PETSc.IntType),
        np.arange(first, last, dtype=PETSc.IntType),
    )
    matrix.setValuesBlockedIJV(begin, columns, blocks.reshape(-1, 3, 3), addv=True)
    matrix.assemble()


def aij(rows: csr_array, like: PETSc.Mat) -> PETSc.Mat:
    """Return a matrix of the type and sizes of another with this rank's ``rows``."""
    matrix = PETSc.Mat().create(like.comm)
    matrix.setSizes(like.getSizes())
    matrix.setBlockSize(3)
    matrix.setType(like.getType())
    begin, columns = (part.astype(PETSc.IntType) for part in (rows.indptr, rows.indices))
    matrix.setPreallocationCSR((begin, columns, rows.data))
    return matrix
