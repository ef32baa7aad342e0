"""Whether a step has come to a minimum of g: the lowest curvature of its true Hessian H = M + t^2 (Hessian of E).

F = 0 on a saddle, too, and a symmetric start stays on it. Where no spring is compressed enough, and no cell resists, H is
positive definite for certain, which one pass over the springs tells. Elsewhere the lowest eigenvalue of M^(-1) H is looked
for by locally optimal conjugate gradients, preconditioned as the step is (Knyazev 2001, Toward the optimal preconditioned
eigensolver, Algorithm 4.1): at some length when the body is compressed anew or more than it was, or something showed a
negative curvature; at all other steps the mode found last is followed in a few iterations.
"""

from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc
from scipy.linalg import eigh

from msmpetsc.model.saved import Saved
from msmpetsc.model.start import uniform
from msmpetsc.place.arrays import beside, fetch, greatest
from msmpetsc.solve.functional import StepFunctional
from msmpetsc.solve.operators import Preconditioner, TrueHessian

MOST = 300  # iterations of a long search
FOLLOWED = 4  # of a short one
LEAST = 24  # of a long one that finds nothing
SETTLED = 0.95  # of the curvature when half as many iterations were done: there is no lower one to come
SHARPENED = 1.1  # times a negative curvature four iterations ago: further ones lead down no steeper
MORE = 4.0  # times the compression of the last long search: time for another, and sooner if that found less than
ALLOWED = 0.5  # that the curvature may have lost since, in proportion to the compression
TINY = np.finfo(float).tiny
DEPENDENT = 1e-10  # eigenvalue of the Gram matrix of three unit directions: one of them is none


@dataclass(frozen=True)
class Compression:
    """Of all ranks: the greatest and the sum over free nodes of t^2 concavity / m; whether a cell resists."""

    greatest: float
    total: float
    resists: bool

    @property
    def is_harmless(self) -> bool:
        """H is positive definite for certain: M outweighs all that is negative in it."""
        return self.least_curvature > 0

    @property
    def least_curvature(self) -> float:
        """No eigenvalue of M^(-1) H is less; 0 where none can be told."""
        return max(1 - self.greatest, 0.0) if not self.resists else 0.0

    def exceeds(self, other: "Compression", times: float) -> bool:
        return self.greatest > times * other.greatest or self.total > times * other.total


NONE = Compression(0.0, 0.0, False)


class LowestCurvature:
    """Looks for directions of negative curvature of a step's Hessian. All methods but properties are collective.

    preconditioner : of the step's linear solves
    """

    def __init__(self, functional: StepFunctional, hessian: TrueHessian, preconditioner: Preconditioner):
        self.functional, self.hessian, self.preconditioner = functional, hessian, preconditioner
        self.comm, self.unknowns, self.memory = functional.comm, functional.unknowns, functional.memory
        self.its = 0  # of all searches so far, one product with H each
        self.searched = NONE  # the compression that the last long search was at
        self.value = 1.0  # that it found
        self.mode: np.ndarray | None = None  # the lowest known (n,), of unit length in the norm of M
        self.basis: np.ndarray | None = None
        self.rigid: np.ndarray | None = None  # motions (6, n) that are left out

    def compression(self, q: np.ndarray) -> Compression:
        """At positions q (l, 3) [m]."""
        functional, free = self.functional, self.unknowns.free
        elasticity = functional.elasticity
        shares = functional.t2 * elasticity.concavity(q)[free] / functional.lattice.mass[free]
        found = self.comm.allgather((greatest(shares), float(shares.sum()), elasticity.resists(q)))
        most, sums, resist = zip(*found, strict=True)
        return Compression(max(most), sum(sums), any(resist))

    def lowest(self, compression: Compression, alarmed: bool, hint: PETSc.Vec | None) -> tuple[float, np.ndarray]:
        """The lowest eigenvalue of M^(-1) H that was found, and its direction (n,), about where H was linearised last.

        alarmed : something showed a negative curvature
        hint    : a direction that may have part in it
        """
        at_length = alarmed or compression.resists or self.mode is None or self._is_time(compression)
        self._create_arrays()
        if at_length:
            self.searched = NONE if alarmed else compression  # what was doubtful is so in the next step, too
            value = self.value = self._search_at_length(hint)
        else:
            self.basis[0], self.basis[2] = self.mode, self._random()
            self._begin(0, 2)
            value = self._iterate(FOLLOWED, FOLLOWED)
        self.mode = self.basis[0].copy()
        return value, self.mode

    def _is_time(self, compression: Compression) -> bool:
        """For a long search."""
        return compression.exceeds(self.searched, min(MORE, ALLOWED / max(1 - self.value, ALLOWED / MORE)))

    def _search_at_length(self, hint: PETSc.Vec | None) -> float:
        """From something of each mode, for near a mode that is known a lower one comes up late, and without rigid motions,
        for their curvature mostly is about 1, which would hide a lower one as long; then from the best of all of them."""
        rigid = self.rigid = self._rigid_motions()
        self.basis[0] = self._random()
        if hint is not None:
            self.basis[0] += self.memory.read(hint) / max(self._length(self.memory.read(hint)), TINY)
        self._begin(0)
        self._iterate(MOST, LEAST)
        self.rigid = None
        known = [self.mode[None]] if self.mode is not None else []
        self._combine(np.concatenate([self.basis[:1], *known, *([] if rigid is None else [rigid])]))
        self._begin(0)
        return self._iterate(MOST, LEAST // 2)

    def _random(self) -> np.ndarray:
        """Something of each mode (n,), the same for any number of ranks, little of the stiff ones."""
        lattice, free = self.functional.lattice, fetch(self.unknowns.free)
        random = uniform(lattice.global_numbers[: lattice.owned])[free].T.ravel() - 0.5
        self.basis[1] = beside(self.basis, random)
        self._precondition(1)
        return self.basis[1] / max(self._length(self.basis[1]), TINY)

    def _begin(self, *rows: int) -> None:
        """Iterations from directions that stand in the first row, and in another."""
        for row in rows:
            self._leave_out_rigid(row)
            self.basis[row] /= max(self._length(self.basis[row]), TINY)
            self.hessian.mult(None, self.vectors[row], self.images[row])
        self.directions = len(rows)

    def _iterate(self, most: int, least: int) -> float:
        """The lowest eigenvalue that the iterations come to; basis[0] is its direction."""
        values = [float(self._sum(self.basis[0] @ self.products[0]))]
        for its in range(1, most + 1):
            values.append(self._improve(values[-1]))
            if values[-1] < 0:
                if its >= 4 and values[-1] > SHARPENED * values[-5]:
                    break
            elif its >= least and values[-1] > SETTLED * values[its // 2]:
                break
        return values[-1]

    def _improve(self, value: float) -> float:
        """One iteration: the lowest curvature in the span of the mode, its preconditioned residual and the last move."""
        mass, basis, products = self.functional.mass, self.basis, self.products
        basis[1] = products[0] - value * mass * basis[0]
        self._precondition(1)
        self.its += 1
        self._leave_out_rigid(1)
        length = self._length(basis[1])
        if not length > 0:
            return value
        basis[1] /= length
        self.hessian.mult(None, self.vectors[1], self.images[1])
        self.directions = min(self.directions + 1, 3)
        grams = self._sum(np.stack([fetch(basis @ products.T), fetch((basis * mass) @ basis.T)]))
        size = self.directions
        while np.linalg.eigvalsh(grams[1, :size, :size])[0] < DEPENDENT:
            size -= 1
        if size == 1:
            return value
        (value, *_), parts = eigh(*(0.5 * (gram + gram.T)[:size, :size] for gram in grams))
        parts = parts[:, 0] * np.copysign(1.0, parts[0, 0])  # so that the way it points does not hang on rounding
        first, rest = parts[0], beside(basis, parts[1:])
        moved, moved_product = rest @ basis[1:size], rest @ products[1:size]
        basis[0], products[0] = first * basis[0] + moved, first * products[0] + moved_product
        length = self._length(moved)
        if length > 0:
            basis[2], products[2] = moved / length, moved_product / length
        else:
            self.directions = 1
        return float(value)

    def _precondition(self, row: int) -> None:
        """basis[row] becomes P^(-1) times itself."""
        self.preconditioner.apply(None, self.vectors[row], self.images[row])
        self.basis[row] = self.products[row]

    def _rigid_motions(self) -> np.ndarray | None:
        """Translations and rotations of a free body at functional.q, (6, n) orthonormal in M; None if nodes are held."""
        if self.unknowns.total < self.functional.lattice.table.total:
            return None
        columns = self.functional.q[self.unknowns.free].T
        motions = np.zeros((6, *columns.shape), like=columns)
        for c in range(3):
            motions[c, c] = 1.0
            motions[3 + c, (c + 1) % 3], motions[3 + c, (c + 2) % 3] = -columns[(c + 2) % 3], columns[(c + 1) % 3]
        motions = motions.reshape(6, -1)
        for _ in range(2):  # once more, for what the first left of rounding
            sizes, parts = np.linalg.eigh(self._sum(fetch((motions * self.functional.mass) @ motions.T)))
            kept = sizes > DEPENDENT * sizes[-1]
            motions = beside(motions, (parts[:, kept] / np.sqrt(sizes[kept])).T) @ motions
        return motions

    def _leave_out_rigid(self, row: int) -> None:
        if self.rigid is not None:
            parts = self._sum(fetch(self.rigid @ (self.functional.mass * self.basis[row])))
            self.basis[row] -= beside(self.basis, parts) @ self.rigid

    def _combine(self, span: np.ndarray) -> None:
        """basis[0] becomes the direction of lowest curvature in the span of the rows (k, n)."""
        products = np.empty_like(span)
        for row in range(len(span)):
            self.basis[1] = span[row]
            self.hessian.mult(None, self.vectors[1], self.images[1])
            products[row] = self.products[1]
        grams = self._sum(np.stack([fetch(span @ products.T), fetch((span * self.functional.mass) @ span.T)]))
        sizes, parts = np.linalg.eigh(grams[1])
        parts = parts[:, sizes > DEPENDENT * sizes[-1]] / np.sqrt(sizes[sizes > DEPENDENT * sizes[-1]])
        _, best = np.linalg.eigh(parts.T @ (0.5 * (grams[0] + grams[0].T)) @ parts)
        best = parts @ best[:, 0]
        self.basis[0] = beside(self.basis, best * np.copysign(1.0, best[0])) @ span

    def _create_arrays(self) -> None:
        """Mode, residual and last move (3, n), and what H makes of each; vectors of PETSc's over the rows."""
        if self.basis is not None:
            return
        like = self.functional.mass
        self.basis, self.products = np.zeros((3, len(like)), like=like), np.zeros((3, len(like)), like=like)
        self.vectors = [self.memory.over(row, self.comm) for row in self.basis]
        self.images = [self.memory.over(row, self.comm) for row in self.products]

    def _length(self, direction: np.ndarray) -> float:
        """In the norm of M."""
        return float(np.sqrt(self._sum(float(direction**2 @ self.functional.mass))))

    def _sum(self, values: np.ndarray | float) -> np.ndarray:
        return self.comm.allreduce(np.asarray(fetch(values) if isinstance(values, np.ndarray) else float(values)))

    def save(self, saved: Saved) -> None:
        """What the next step's search depends on."""
        lattice = self.functional.lattice
        rows = saved.rows["lowest_mode"] = np.zeros((lattice.owned, 3), like=lattice.nodes)
        if self.mode is not None:
            rows[self.unknowns.free] = self.mode.reshape(3, -1).T
        saved.numbers |= {"searched_greatest": self.searched.greatest, "searched_total": self.searched.total}
        saved.numbers |= {"searched_value": self.value, "knows_mode": self.mode is not None}

    def restore(self, saved: Saved) -> None:
        """Go on from there; from nothing saved as if no step had been taken."""
        numbers = saved.numbers
        self.searched = Compression(numbers.get("searched_greatest", 0.0), numbers.get("searched_total", 0.0), False)
        self.value, self.mode = numbers.get("searched_value", 1.0), None
        if numbers.get("knows_mode"):
            rows = beside(self.functional.mass, saved.rows["lowest_mode"])
            self.mode = rows[self.unknowns.free].T.ravel()

    def destroy(self) -> None:
        if self.basis is not None:
            for vector in (*self.vectors, *self.images):
                vector.destroy()
