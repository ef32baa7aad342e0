"""Viscosity of a neo-Hookean solid in an implicit step: that of Kelvin and Voigt, cell by cell.

With K the Hessian of E at rest, of mean strains alone and turned as each cell has turned, the step's

    D(x) = beta / (2 tau) (x - x^)^T K (x - x^)

adds the forces beta K v, v = (x - x^) / tau: the viscosities are beta mu and beta lambda. A cell that turns alone costs
nothing but for what its turn was not foreseen. D is convex, and its K constant in a step. Modes of a cell are left out:
they turn with it, and would have to be turned, too. Of n cells across they are 1 / n^2 of a bend.
"""

import numpy as np

from msmpetsc.backend.arrays import Floats, Positions, Rows
from msmpetsc.backend.kernel import kernel
from msmpetsc.elasticity.cell_blocks import ROWS, STATE, CellRows, one_by_one
from msmpetsc.elasticity.cell_strain import LANES
from msmpetsc.elasticity.cell_threads import constants_at, gradient_at, state_at
from msmpetsc.elasticity.neo_hookean import rotation_of, write_state
from msmpetsc.elasticity.solid import CellHessians, NeoHookean


@kernel
def _turned_states(
    first: int, count: int, step: int, q: Positions, cells: CellRows, state: Floats
) -> None:
    """Write what a Hessian keeps of cells at rest, turned as those at q (l, 3) [m].

    Cells that are flat or inside out have no rotation: K is not turned then, nor does it forgive a turn.
    """
    for i in range(first, count, step):
        k, (r, turns) = constants_at(cells, i), rotation_of(gradient_at(q, cells, i))
        m = cells.constants[k + 104]
        write_state(state, state_at(i), r, -m if turns else 0.0, m + cells.constants[k + 112])


class Viscosity:
    """D of a step: what Elasticity asks of a law.

    factor : beta / tau
    owned  : number of nodes that this rank owns
    before : x^ (l, 3) [m]; at first the nodes at rest
    """

    def __init__(self, solid: NeoHookean, factor: float, owned: int, before: Positions):
        constants = solid.blocks.constants.copy().reshape(-1, ROWS, LANES)
        constants[:, 6 : ROWS - 2] = 0.0  # modes
        constants[:, ROWS - 2 :] *= factor
        self.blocks = solid.blocks._replace(constants=constants.reshape(len(constants), -1))
        self.owned, self.before, self.hessian = owned, before, self._turned_as(before)

    def begin(self, before: Positions, turned: Positions) -> None:
        """Take the data of a new step: x^ (l, 3) [m], and positions (l, 3) whose cells have turned as in the step."""
        self.before, self.hessian = before, self._turned_as(turned)

    def _turned_as(self, q: Positions) -> CellHessians:
        state = np.empty((len(self.blocks.nodes), STATE * LANES), like=q)
        _turned_states(LANES * len(state), q, one_by_one(self.blocks), state.ravel())
        return CellHessians(self.blocks, state)

    def energy(self, q: Positions) -> float:
        """Return this rank's part of D [J]."""
        return self.change(q, self.before)

    def change(self, q: Positions, base: Positions) -> float:
        """Return this rank's part of D(q) - D(base) [J], that of its nodes' forces."""
        both, product, owned = (
            (q - self.before) + (base - self.before),
            np.zeros_like(q),
            self.owned,
        )
        self.hessian(both, product)
        return 0.5 * float(np.vdot(q[:owned] - base[:owned], product[:owned]))

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add grad D [N] to ``gradient`` (l, 3)."""
        self.hessian(q - self.before, gradient)

    def hessian_at(self, _: Positions, __: bool, dtype: type = np.float64) -> CellHessians:
        """Return what adds (Hessian of D) v [N] to its second argument."""
        constants: Rows = self.blocks.constants.astype(dtype, copy=False)
        return CellHessians(
            self.blocks._replace(constants=constants), self.hessian.state.astype(dtype, copy=False)
        )

    def add_bound(self, _: Positions, blocks: Rows) -> None:
        """Add the diagonal blocks of the Hessian to ``blocks`` (l, 9) [N/m]."""
        self.hessian.add_diagonal(blocks)
