"""Floating point operations of the loops over springs and cells, for PETSc's log.

Each +, -, x, /, square root and maximum counts as one, as PETSc counts its own. The numbers are read off the loops of
elasticity.springs, one spring a turn, Hooke's law first and what stiffening adds to it second. So they are those of the
CPU's loops: a GPU's visit each spring twice, and work out its block again in each product.
"""

from dataclasses import dataclass

from msmpetsc.model.lattice import Lattice

# p_a - p_b 3, its length 6, the pull k (1 - r / l) 4, times p_a - p_b 3, added to both ends 6; its strain and law 6
GRADIENT = 22, 6
# three differences 9, two lengths 12, l + l' 1, how much longer it is 10, the energy 6; two strains and the law 11
CHANGE = 38, 11
# p_a - p_b 3, its length 7, 1 - r / l 2, along it 4, c and e 4; its strain and both moduli 10
HESSIAN = 20, 10
# v_a - v_b 3, e . d 5, c d + (e . d) e 9, added to both ends 6
PRODUCT = 23
# edges and cofactors of a corner 36, its lack of volume 8, its slope 4; those few that resist have more, not counted
CORNER = 48
LEAST_VOLUME = 155  # of a cell: twelve edges 36, eight corners' volumes 112, their minimum 7
# of a node, all its coordinates: M (x - y) + t^2 (grad E - f), the inertia and work of a change, M v + t^2 p
GRADIENT_ROW, CHANGE_ROW, PRODUCT_ROW = 15, 36, 9


@dataclass(frozen=True)
class Flops:
    """Operations of one call on this rank: the gradient of g, a change of g, the Hessian at a point, a product."""

    gradient: int
    change: int
    hessian: int
    product: int

    @classmethod
    def of_lattice(cls, lattice: Lattice) -> "Flops":
        """Return those of a lattice, M included."""
        springs, stiffens, owned = len(lattice.springs), lattice.stiffening > 0, lattice.owned
        cells = len(lattice.local_cells) if stiffens else 0
        gradient, change, hessian = (a + stiffens * b for a, b in (GRADIENT, CHANGE, HESSIAN))
        return cls(
            gradient * springs + 8 * CORNER * cells + GRADIENT_ROW * owned,
            change * lattice.springs_owned + 2 * LEAST_VOLUME * cells + CHANGE_ROW * owned,
            hessian * springs + LEAST_VOLUME * cells,
            PRODUCT * springs + PRODUCT_ROW * owned,
        )
