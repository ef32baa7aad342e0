"""Viscosity of a neo-Hookean solid in an implicit step: that of Kelvin and Voigt, cell by cell.

With K the Hessian of E at rest, of mean strains alone and turned as each cell has turned, the step's

    D(x) = beta / (2 tau) (x - x^)^T K (x - x^)

adds the forces beta K v, v = (x - x^) / tau: the viscosities are beta mu and beta lambda. A cell that turns alone costs
nothing but for what its turn was not foreseen. D is convex, and its K constant in a step. Modes of a cell are left out:
they turn with it, and would have to be turned, too. Of n cells across they are 1 / n^2 of a bend.
"""

from dataclasses import dataclass, field
from functools import partial

import numba
import numpy as np

from msmpetsc.backend.arrays import Positions, Rows
from msmpetsc.elasticity.cell_lanes import AT_STATE, CONSTANTS, ROWS, STATE, WORK, Blocks, gather, load, strains_in
from msmpetsc.elasticity.cell_strain import LANES
from msmpetsc.elasticity.neo_hookean import (
    ONSET,
    NeoHookean,
    add_diagonal,
    add_product,
    cofactors,
    determinant,
    gradient_of,
    kept_gradient,
)
from msmpetsc.elasticity.springs import Product

TURNS = 30  # iterations towards a cell's rotation
TURNED = 1e-12  # how little the last one changes of it


@numba.njit(cache=True)
def turned_state(blocks: Blocks, h4: float, q: Positions, state: Rows) -> None:
    """Write what a Hessian keeps of cells at rest, turned as those at q (l, 3) [m], into ``state`` (b, STATE * LANES).

    The rotation of F comes by Newton's iteration R <- (R + R^-T) / 2 (Higham 1986). Cells that are flat or inside out
    (J below J_0 of their law) have none: K is not turned then, nor does it forgive a turn.
    """
    w = np.zeros(WORK)
    for b in range(len(blocks.nodes)):
        gather(blocks.nodes, b, q, w)
        load(blocks.constants, blocks.which[b], w, CONSTANTS)
        for lane in range(LANES):
            r, m = gradient_of(strains_in(w, lane), 1.0 / h4), w[CONSTANTS + (ROWS - 2) * LANES + lane]
            turns = determinant(r, cofactors(r)) > ONSET
            if not turns:
                r = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
            change = 1.0
            for _ in range(TURNS):
                n = cofactors(r)
                over, change = 0.5 / determinant(r, n), 0.0
                for i in range(9):
                    w[AT_STATE + LANES * i + lane] = 0.5 * r[i] + over * n[i]
                    change = max(change, abs(0.5 * r[i] - over * n[i]))
                r = kept_gradient(w, AT_STATE + lane)
                if not change > TURNED:
                    break
            w[AT_STATE + (STATE - 2) * LANES + lane] = -m if turns else 0.0
            w[AT_STATE + (STATE - 1) * LANES + lane] = m + w[CONSTANTS + (ROWS - 1) * LANES + lane]
        for i in range(STATE * LANES):
            state[b, i] = w[AT_STATE + i]


@dataclass(eq=False)
class Viscosity:
    """D of a step: what Elasticity asks of a law.

    blocks : cells with their constants times beta / tau, without modes
    owned  : number of blocks of cells that this rank owns
    """

    blocks: Blocks
    owned: int
    h4: float
    before: Positions  # x^
    state: Rows = field(init=False)

    def __post_init__(self) -> None:
        self.begin(self.before, self.before)

    @classmethod
    def of_solid(cls, solid: NeoHookean, factor: float, rest: Positions) -> "Viscosity":
        """Return the viscosity of a solid; ``factor`` is beta / tau, ``rest`` the nodes (l, 3) [m]."""
        constants = solid.blocks.constants.copy().reshape(-1, ROWS, LANES)
        constants[:, 6 : ROWS - 2] = 0.0
        constants[:, ROWS - 2 :] *= factor
        blocks = solid.blocks._replace(constants=constants.reshape(len(constants), -1))
        return cls(blocks, solid.owned, solid.h4, rest)

    def begin(self, before: Positions, turned: Positions) -> None:
        """Take the data of a new step: x^ (l, 3) [m], and positions (l, 3) whose cells have turned as in the step."""
        self.before, self.state = before, np.empty((len(self.blocks.nodes), STATE * LANES))
        turned_state(self.blocks, self.h4, turned, self.state)

    def energy(self, q: Positions) -> float:
        """Return D [J] of the cells that this rank owns."""
        return self.change(q, self.before)

    def change(self, q: Positions, base: Positions) -> float:
        """Return D(q) - D(base) [J] of the cells that this rank owns."""
        both, product, blocks = (q - self.before) + (base - self.before), np.zeros_like(q), self.blocks
        add_product(blocks.nodes[: self.owned], blocks.which, blocks.constants, self.state, both, product)
        return 0.5 * float(np.vdot(q - base, product))

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add grad D [N] to ``gradient`` (l, 3)."""
        self.hessian_at(q, True)(q - self.before, gradient)

    def hessian_at(self, _: Positions, __: bool, dtype: type = np.float64) -> Product:
        """Return what adds (Hessian of D) v [N] to its second argument."""
        blocks = self.blocks
        constants: Rows = blocks.constants.astype(dtype, copy=False)
        state: Rows = self.state.astype(dtype, copy=False)
        return partial(add_product, blocks.nodes, blocks.which, constants, state)

    def add_bound(self, _: Positions, blocks: Rows) -> None:
        """Add the diagonal blocks of the Hessian to ``blocks`` (l, 9) [N/m]."""
        add_diagonal(self.blocks, self.state, blocks)
