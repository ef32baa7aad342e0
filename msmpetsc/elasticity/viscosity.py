"""Kelvin-Voigt viscosity of a neo-Hookean solid in an implicit step of length tau.

K is the Hessian of E at rest for mean strains alone. Each cell's part of K is rotated as the cell
has rotated. With x^ the positions before the step, the step's dissipation potential is

    D(x) = beta / (2 tau) (x - x^)^T K (x - x^).

D adds the gradient beta K v with v = (x - x^) / tau, so the viscosities are beta mu and
beta lambda. K is constant within a step, so D is convex. A rigid rotation dissipates only as far as
it differs from the rotation given to ``Viscosity.begin``. The modes of a cell are left out, because
K would have to rotate them, too. In a bend over n cells their share of the energy is 1 / n^2.
"""

import numpy as np

from msmpetsc.backend.arrays import Positions, Rows
from msmpetsc.backend.kernel import kernel
from msmpetsc.elasticity.cell_blocks import PROJECTED, ROWS, CellRows, one_by_one
from msmpetsc.elasticity.cell_strain import LANES
from msmpetsc.elasticity.cell_threads import constants_at, state_at, strains_at
from msmpetsc.elasticity.neo_hookean import gradient_of, rotation_of, write_state
from msmpetsc.elasticity.solid import CellHessians, NeoHookean


@kernel
def _turned_states(first: int, count: int, step: int, q: Positions, cells: CellRows) -> None:
    """Write the Hessians' states of cells at rest, rotated as the cells at q (l, 3) [m] are.

    A cell with J <= J_0 has no rotation: its K is not rotated, and resists rotations, too.
    """
    for i in range(first, count, step):
        k = constants_at(cells, i)
        r, has_rotation = rotation_of(gradient_of(strains_at(q, cells, i), 1.0 / cells.h4))
        m = cells.constants[k + 104]
        slope = -m if has_rotation else 0.0
        write_state(cells.state, state_at(cells, i), r, slope, m + cells.constants[k + 112])


class Viscosity:
    """The dissipation potential D of a step, with the methods that Elasticity needs of a law.

    factor : beta / tau [-]
    owned  : number of nodes that this rank owns
    before : x^ (l, 3) [m], positions before the step; positions at rest until ``begin``
    """

    def __init__(self, solid: NeoHookean, factor: float, owned: int, before: Positions):
        constants = solid.blocks.constants.copy().reshape(-1, ROWS, LANES)
        # K leaves out the modes.
        constants[:, 6 : ROWS - 2] = 0.0
        constants[:, ROWS - 2 :] *= factor
        self.blocks = solid.blocks._replace(constants=constants.reshape(len(constants), -1))
        self.owned, self.before, self.hessian = owned, before, self._turned_as(before)

    def begin(self, before: Positions, turned: Positions) -> None:
        """Begin a step: set x^ to ``before``, and rotate K as the cells are at ``turned``.

        before : (l, 3) [m]
        turned : (l, 3) [m], predicted positions of the step
        """
        self.before, self.hessian = before, self._turned_as(turned)

    def _turned_as(self, q: Positions) -> CellHessians:
        state = np.empty((len(self.blocks.nodes), PROJECTED * LANES), like=q)
        _turned_states(LANES * len(state), q, one_by_one(self.blocks, state))
        return CellHessians(self.blocks, state)

    def energy(self, q: Positions) -> float:
        """Return this rank's part of D [J]."""
        return self.change(q, self.before)

    def change(self, q: Positions, base: Positions) -> float:
        """Return this rank's part of D(q) - D(base) [J], by the forces on its owned nodes.

        D(q) - D(base) = 1/2 (q - base)^T H ((q - x^) + (base - x^)), with H the Hessian of D.
        """
        owned = self.owned
        product = np.zeros_like(q)
        self.hessian((q - self.before) + (base - self.before), product)
        return 0.5 * float(np.vdot(q[:owned] - base[:owned], product[:owned]))

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add grad D [N] to ``gradient`` (l, 3)."""
        self.hessian(q - self.before, gradient)

    def hessian_at(self, _: Positions, __: bool, dtype: type = np.float64) -> CellHessians:
        """Return the Hessian of D, in numbers of type ``dtype``."""
        constants: Rows = self.blocks.constants.astype(dtype, copy=False)
        return CellHessians(
            self.blocks._replace(constants=constants), self.hessian.state.astype(dtype, copy=False)
        )

    def add_bound(self, _: Positions, blocks: Rows) -> None:
        """Add the diagonal blocks of the Hessian of D to ``blocks`` (l, 9) [N/m]."""
        self.hessian.add_diagonal(blocks)
