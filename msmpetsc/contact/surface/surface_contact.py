"""Contact of surfaces as a term of the energy that a step minimises: barrier and friction.

Rank 0 does all computations on points. The other ranks send contributions of their nodes to
S = W q, and receive the nonzero rows of forces. The Hessian is never formed on nodes: the product
W^T (H_c (W v)) over the points in contact takes a hundredth of the time.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows
from msmpetsc.comm import reduced, together
from msmpetsc.contact.surface.pairs import ActivePairs, ContactSearch
from msmpetsc.contact.surface.surface_friction import SurfaceFriction
from msmpetsc.errors import StepFailed

# Displacement below which a change of energy is the mean force times the displacement
# [dhat]; a difference of energies would lose its digits
SMALL = 1e-4


@dataclass(frozen=True)
class SurfaceHessian:
    """Hessian W^T H_c W over k points in contact.

    weights : W (k, owned) of this rank's nodes
    points  : H_c (3k, 3k) [N/m], on all ranks
    """

    comm: MPI.Comm
    weights: csr_array
    points: csr_array

    @cached_property
    def _carrying(self) -> tuple[Indices, csr_array, csr_array]:
        """This rank's nodes (c,) that carry points, their weights (k, c), and the transpose."""
        nodes = np.unique(self.weights.indices)
        weights = csr_array(self.weights[:, nodes])
        return nodes, weights, csr_array(weights.T)

    def add_product(self, v: Array, product: Array) -> None:
        """Add the Hessian times v (owned or more, 3) to owned rows of ``product`` (collective)."""
        nodes, weights, back = self._carrying
        moved = weights @ v[nodes].astype(float, copy=False)
        if self.comm.size > 1:
            self.comm.Allreduce(MPI.IN_PLACE, moved)
        product[nodes] += back @ (self.points @ moved.ravel()).reshape(-1, 3)

    def split(
        self, compliance: Floats, most: int
    ) -> "tuple[SurfaceHessian | None, SurfaceHessian | None]":
        """Return the Hessians of stiff points and of the remaining points; None for no points.

        compliance : (owned,) compliance of this rank's nodes [m/N]; a point stiffer than its nodes
                     is stiff
        most       : greatest number of stiff points; the stiffest points come first
        """
        # ``power`` sorts its matrix in place
        given = reduced(self.comm, self.weights.copy().power(2) @ compliance)
        stiffness = self.points.diagonal().reshape(-1, 3).sum(axis=1) * given
        order = np.argsort(-stiffness, kind="stable")
        stiff = min(most, int((stiffness > 1).sum()))
        parts = np.sort(order[:stiff]), np.sort(order[stiff:])
        joined, remaining = (self._part(numbers) if len(numbers) else None for numbers in parts)
        return joined, remaining

    def _part(self, numbers: Indices) -> "SurfaceHessian":
        rows = (3 * numbers[:, None] + np.arange(3)).ravel()
        return SurfaceHessian(
            self.comm, self.weights[numbers], csr_array(self.points[rows][:, rows])
        )

    @cached_property
    def blocks(self) -> Rows:
        """Diagonal blocks (owned, 9) [N/m]."""
        nodes, weights, _ = self._carrying
        points, blocks = self.points.tobsr((3, 3)), np.zeros((self.weights.shape[1], 9))
        # First point of each block; then w w' for all nodes that carry both points
        first = np.repeat(np.arange(len(points.indptr) - 1), np.diff(points.indptr))
        both = weights[first].multiply(weights[points.indices])
        blocks[nodes] = both.T @ points.data.reshape(-1, 9)
        return blocks


class SurfaceContact:
    """Contact of surfaces in one step. All methods are collective.

    start        : pairs at the start of the step
    last         : positions (l, 3) [m] one step before the start of the step, for BDF2, whose slip
                   is the end velocity times tau
    end          : pairs at the end of an earlier solve of the step, which give the normal forces of
                   friction; None for the normal forces at the start
    before       : contact in the last step
    has_friction : whether there is friction
    has_history  : whether ``last`` is given
    friction     : friction in the step, on rank 0
    """

    def __init__(
        self,
        contacts: ContactSearch,
        start: ActivePairs,
        time_step: float,
        last: Positions | None = None,
        end: ActivePairs | None = None,
        before: "SurfaceContact | None" = None,
    ):
        self.contacts, self.comm, self.start = contacts, contacts.comm, start
        self.has_history = last is not None
        pairs = end or start
        self.has_friction = contacts.law.friction > 0 and pairs.count > 0
        self.friction: SurfaceFriction | None = None
        if self.has_friction:
            came = None if last is None else contacts.points.moved(start.q - last)
            friction = self._friction(pairs, start.points, came, time_step, end is None)
            self.friction = (
                friction.after(before.friction, start.points) if friction and before else friction
            )

    def _friction(
        self,
        pairs: ActivePairs,
        points: Positions,
        came: Rows | None,
        time_step: float,
        extrapolates: bool,
    ) -> SurfaceFriction | None:
        """Return friction with the normal forces of the pairs, on rank 0.

        points       : (p, 3) points at the start of the step [m]
        came         : (p, 3) displacements in the last step [m], for BDF2; None otherwise
        extrapolates : whether BDF2 extrapolates the normal forces
        """
        contacts, barrier, stick = (
            self.contacts,
            self.contacts.barrier,
            self.contacts.law.stick * time_step,
        )
        if barrier is None:
            return None
        if came is None:
            return barrier.friction(pairs.sets, pairs.points, points, stick)
        if contacts.obstacles.total:
            came[contacts.points.bodies :] = contacts.obstacles.displacements_before(
                contacts.begin, contacts.time
            )
        friction = barrier.friction(pairs.sets, pairs.points, points + came / 3, 2 / 3 * stick)
        if friction is None or not extrapolates:
            return friction
        before = friction.values_of(*barrier.friction_limits(pairs.sets, points - came))
        return replace(friction, limit=np.clip(2 * friction.limit - before, 0, 2 * friction.limit))

    def at(self, q: Positions) -> "SurfaceContactAt":
        """Return the contact at positions q (owned or more, 3) [m]."""
        return SurfaceContactAt(self, self.contacts.find(q))


@dataclass(frozen=True)
class SurfaceContactAt:
    """Contact of surfaces at given positions in a step, with its derivatives.

    All methods and properties are collective.

    step  : contact in the step
    pairs : pairs that push at the positions
    """

    step: SurfaceContact
    pairs: ActivePairs

    @property
    def contacts(self) -> ContactSearch:
        """Search of the contacts."""
        return self.step.contacts

    @property
    def presses(self) -> bool:
        """Whether contact acts."""
        return self.pairs.count > 0 or self.step.has_friction

    def friction_limits(self) -> Floats:
        """Return the sums of mu N [N], (2,): as friction uses it, and here; 0 on ranks above 0."""
        barrier, friction = self.contacts.barrier, self.step.friction
        if self.contacts.law.friction == 0 or not barrier:
            return np.zeros(2)
        used = friction.limit.sum() if friction else 0.0
        return np.array(
            [used, barrier.friction_limits(self.pairs.sets, self.pairs.points)[1].sum()]
        )

    def change(self, base: "SurfaceContactAt") -> float:
        """Return this rank's part of the energy here minus that at base, with friction [J].

        Over a small displacement the change is the displacement times the mean force, since a
        difference of energies would lose its digits.
        """
        before, after, friction = base.pairs, self.pairs, self.step.friction
        gone, of_friction = np.abs(after.points - before.points).max(initial=0.0), 0.0
        is_small = self.step.comm.bcast(gone < SMALL * self.contacts.law.distance)
        moved = self.contacts.points.moved(after.q - before.q) if is_small else None
        if friction:
            of_friction = friction.change(after.points, before.points, moved)
        if moved is not None:
            mean = 0.5 * (base._pushes() + self._pushes())
            return of_friction + float(np.vdot(mean, moved))
        return of_friction + self._energy() - base._energy()

    def _energy(self) -> float:
        """Return the energy [J] of the barrier on rank 0, else 0."""
        barrier, pairs = self.contacts.barrier, self.pairs
        return barrier.energy(pairs.sets, pairs.points) if barrier else 0.0

    def add_gradient(self, gradient: Rows) -> None:
        """Add the gradient [N] to ``gradient`` (owned or more, 3)."""
        self._add_to_nodes(self._gradient(), gradient)

    def _add_to_nodes(self, forces: Rows, gradient: Rows) -> None:
        """Add W^T f of forces (total, 3) [N] on rank 0 to ``gradient`` (owned or more, 3)."""
        points = self.contacts.points
        touched = np.flatnonzero(forces[: points.bodies].any(axis=1))
        touched, forces = self.step.comm.bcast((touched, forces[touched]))
        weights = points.carried(touched)
        gradient[: weights.shape[1]] += weights.T @ forces

    def add_change_of_gradient(self, displacements: Rows, gradient: Rows) -> None:
        """Add the first-order change of the gradient [N] as obstacles move.

        The change is a product with the projected Hessian.

        displacements : (o, 3) of the obstacles' points [m]
        """
        moved = np.zeros_like(self.pairs.points)
        if len(moved):
            moved[self.contacts.points.bodies :] = displacements
        whole = self._whole_hessian(True, None)
        self._add_to_nodes(
            moved if whole is None else (whole @ moved.ravel()).reshape(-1, 3), gradient
        )

    def _gradient(self) -> Rows:
        """Return the gradient (total, 3) [N] with friction on rank 0; (0, 3) elsewhere."""
        friction = self.step.friction
        return self._pushes() + (friction.gradient(self.pairs.points) if friction else 0.0)

    def _pushes(self) -> Rows:
        """Return the gradient (total, 3) [N] of the barrier on rank 0; (0, 3) elsewhere."""
        return self.contacts.pushes(self.pairs)

    def of_obstacles(self, frame: Floats | float = 0.0) -> tuple[Rows, float]:
        """Return obstacles' forces (k, 3) [N] on the bodies, and their work [J] in the step.

        The work is of the force at the end of the step: an upper bound for a convex energy. In a
        step of BDF2 the obstacles have their velocity at its end, as in friction. If an obstacle
        turns at w, its displacement in the step makes an angle w t / 2 with this velocity.

        frame : (3,) displacement of the frame [m] in which the work is counted
        """
        points, obstacles = self.contacts.points, self.contacts.obstacles
        step = self.contacts.begin, self.contacts.time
        forces_and_work = np.zeros((len(obstacles.numbers), 3)), 0.0
        if obstacles.total:
            if len(self.pairs.points):
                forces = self._gradient()[points.bodies :]
                moved = obstacles.displacements(*step)
                if self.step.has_history:
                    moved = 1.5 * moved - 0.5 * obstacles.displacements_before(*step)
                work = float((forces * (moved - frame)).sum())
                forces_and_work = obstacles.sums(forces), work
            forces_and_work = self.step.comm.bcast(forces_and_work)
        return forces_and_work

    def pressing_displacement(self) -> tuple[float, Floats]:
        """Return the sum of forces [N], and the sum (3,) [N m] of force times displacement.

        Both sums run over obstacles' points, at the step's start and here, without friction. They
        are zero on ranks above 0.
        """
        contacts, total, weighted = self.contacts, 0.0, np.zeros(3)
        if contacts.obstacles.total:
            moved = contacts.obstacles.displacements(contacts.begin, contacts.time)
            for pairs in (self.step.start, self.pairs):
                if pairs.count and len(pairs.points):
                    pushes = contacts.pushes(pairs)[contacts.points.bodies :]
                    forces = np.linalg.norm(pushes, axis=1)
                    total += float(forces.sum())
                    weighted += (forces[:, None] * moved).sum(axis=0)
        return total, weighted

    def released(self) -> float:
        """Return the energy [J] of elastic slips at the start minus that here, on rank 0."""
        friction = self.step.friction
        return friction.released(self.pairs.points) if friction else 0.0

    def duals_after(self, base: "SurfaceContactAt", duals: Rows | None) -> Rows | None:
        """Return friction's duals (a, 3) after the full step from base to here.

        duals : (a, 3) at base; None for the forces of the slips
        """
        if self.step.friction:
            points = self.pairs.points, base.pairs.points
            duals = self.step.friction.duals_after(*points, duals)
        of_root: Rows | None = self.step.comm.bcast(duals)
        return of_root

    @cached_property
    def _true_hessian(self) -> SurfaceHessian | None:
        """True Hessian; None if no contact acts."""
        return self._hessian(False, None)

    def hessian(self, projected: bool, duals: Rows | None = None) -> SurfaceHessian | None:
        """Return the Hessian; None if no contact acts.

        projected : project the Hessian of each pair to be positive semidefinite
        duals     : (a, 3) duals of friction; None for the true Hessian of friction
        """
        is_true = not projected and duals is None
        return self._true_hessian if is_true else self._hessian(projected, duals)

    def _hessian(self, projected: bool, duals: Rows | None) -> SurfaceHessian | None:
        if not self.presses:
            return None
        whole, touched, points = self._whole_hessian(projected, duals), None, None
        if whole is not None:
            rows = whole.indptr[: 3 * self.contacts.points.bodies + 1]
            touched = np.flatnonzero(np.diff(rows).reshape(-1, 3).any(axis=1))
            numbers = (3 * touched[:, None] + np.arange(3)).ravel()
            points = csr_array(whole[numbers][:, numbers])
        touched, points = self.step.comm.bcast((touched, points))
        return SurfaceHessian(self.step.comm, self.contacts.points.carried(touched), points)

    def concavity(self) -> Floats:
        """Return a diagonal (owned,) [N/m] that bounds the Hessian's negative part on nodes.

        The diagonal of row sums r bounds the negative part on points. The bound on nodes follows
        from (sum w v)^2 <= (sum |w|) (sum |w| v^2).
        """
        points, touched, sums = self.contacts.points, None, None
        whole, kept = (self._whole_hessian(projected, None) for projected in (False, True))
        if whole is not None and kept is not None:
            part = np.abs((kept - whole)[: 3 * points.bodies, : 3 * points.bodies])
            sums = np.asarray(part.sum(axis=1)).reshape(-1, 3).max(axis=1)
            touched = np.flatnonzero(sums)
            sums = sums[touched]
        touched, sums = self.step.comm.bcast((touched, sums))
        bound: Floats = points.spread * (np.abs(points.carried(touched)).T @ sums)
        return bound

    def _whole_hessian(self, projected: bool, duals: Rows | None) -> csr_array | None:
        """Return the Hessian (3 total, 3 total) [N/m] of all points on rank 0, else None.

        Raises StepFailed if the Hessian is not finite.
        """
        barrier, pairs = self.contacts.barrier, self.pairs
        with together(self.step.comm):
            try:
                parts = barrier.hessian(pairs.sets, pairs.points, projected) if barrier else []
                is_finite = all(np.isfinite(part.data).all() for part in parts)
            # ipctk cannot project a pair's Hessian that is not finite
            except RuntimeError:
                is_finite = False
            if not is_finite:
                raise StepFailed(
                    f"has contact forces that are not finite: {self.contacts.in_words(pairs)}; "
                    "try a smaller time.step, or paths that leave the body more room",
                    "contact",
                )
        if barrier is None:
            return None
        if self.step.friction:
            parts.append(self.step.friction.hessian(pairs.points, duals))
        return csr_array(sum(parts)) if parts else csr_array((pairs.points.size,) * 2)

    def bound(self) -> Floats:
        """Return bounds (owned,) [N/m] of the diagonal blocks of the true Hessian.

        The bounds are rounded up to powers of 4, so that they seldom change.
        """
        hessian = self.hessian(False)
        if hessian is None:
            return np.zeros(self.contacts.owned)
        norms = np.abs(hessian.blocks).reshape(-1, 3, 3).sum(axis=2).max(axis=1)
        with np.errstate(divide="ignore"):
            bound: Floats = 4.0 ** np.ceil(np.log2(norms) / 2)
        return bound
