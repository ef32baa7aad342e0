"""Lumped masses of nodes and stiffnesses of springs, summed cell by cell for either law.

lattice.cut_cells and lattice.cell_moments give the fractions of cells that the surface cuts.
"""

from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.lattice.cell_moments import WHOLE, bounding_laplacians, forms_of, laplacians
from msmpetsc.lattice.cut_cells import STRENGTH, mass_fractions, spring_fractions
from msmpetsc.lattice.material import (
    CellMaterial,
    MaterialOfCells,
    edge_stiffness,
    lame_constants,
)
from msmpetsc.lattice.topology import DIRECTION, SpringNet, Topology
from msmpetsc.scene.body import Material


class SolidCells(NamedTuple):
    """Constants of a solid for each of a lattice's ``local_cells`` (elasticity.neo_hookean).

    forms  : (d, 13) strain forms of the cells (lattice.cell_moments)
    volume : (d,) volume inside the surface [m^3]
    shear, lame : (d,) mu and lambda [Pa]
    """

    forms: Rows
    volume: Floats
    shear: Floats
    lame: Floats

    @property
    def bounds(self) -> Floats:
        """Return (2 mu + 3 lambda) V (d,) [J].

        The product with the mean |grad u|^2 in a cell bounds the second variation at rest.
        """
        return (2 * self.shear + 3 * self.lame) * self.volume


class LawConstants(NamedTuple):
    """The material data of a rank's nodes, springs and cells.

    mass    : (owned,) [kg]
    cells   : (d,) stiffness of an edge spring inside a body of the cell's material [N/m]
    springs : (s,) stiffness [N/m]; empty for a solid
    solid   : (d,) constants of a solid's cells; None for springs
    """

    mass: Floats
    cells: Floats
    springs: Floats
    solid: SolidCells | None = None


def law_of_springs(
    net: Topology,
    springs: SpringNet,
    h: float,
    material: Material,
    of_cells: MaterialOfCells | None,
) -> LawConstants:
    """Return the masses and stiffnesses of springs (collective).

    If the material gives ``stiffness``, a spring has the mean over the cells that share it. If it
    gives Young's modulus, the spring has the sum of the cells' parts.
    """
    owned = len(net.octants)
    made_of, fills, _ = _made_of(net, material, of_cells)
    of_pairs = spring_fractions(fills)
    of_corners = made_of.density[:, None] * mass_fractions(of_pairs)
    mass = h**3 / 8 * np.bincount(net.cells.ravel(), of_corners.ravel(), owned)[:owned]
    cells = fills.mean(axis=1) * made_of.spring
    if material.stiffness is not None:
        sums = _sums_of_springs(net, springs, made_of.spring, of_pairs)
        return LawConstants(mass, cells, sums / springs.sharing)
    sums = _sums_of_springs(net, springs, made_of.spring, STRENGTH * of_pairs)
    return LawConstants(mass, edge_stiffness(cells, h), edge_stiffness(sums, h))


def _made_of(
    net: Topology, material: Material, of_cells: MaterialOfCells | None
) -> tuple[CellMaterial, Rows, Rows]:
    """Return the materials of the cells around a rank's nodes, by ``of_cells`` if it is given.

    Also return the cells' fills and moments, weighted by stiffness (collective).
    """
    fills, moments = net.cages.materials_of(net.keys)
    if not of_cells:
        of_all = material.density, material.spring, material.poisson_ratio
        density, spring, poisson = (np.full(len(net.cells), value) for value in of_all)
        return CellMaterial(density, spring, poisson), fills, moments
    made_of = of_cells(net.keys)
    if made_of.mixed is not None:
        rows, fills[rows], moments[rows] = made_of.mixed
    return made_of, fills, moments


def law_of_solid(
    net: Topology, h: float, material: Material, of_cells: MaterialOfCells | None
) -> LawConstants:
    """Return masses and cell constants of a solid (collective).

    A corner's lumped mass is proportional to the diagonal of L, as with springs.
    """
    owned, count = len(net.octants), len(net.cells)
    made_of, *parts = _made_of(net, material, of_cells)
    shear, lame = lame_constants(made_of.spring, made_of.poisson)
    forms, volume, cut = _forms(*parts)
    diagonal = np.broadcast_to(
        laplacians(WHOLE[None], np.ones(1)).diagonal(axis1=1, axis2=2), (count, 8)
    )
    if len(cut):
        diagonal = diagonal.copy()
        diagonal[cut] = laplacians(forms[cut], volume[cut]).diagonal(axis1=1, axis2=2)
    of_corners = (made_of.density * volume / diagonal.sum(axis=1))[:, None] * diagonal
    mass = h**3 * np.bincount(net.cells.ravel(), of_corners.ravel(), owned)[:owned]
    cells = SolidCells(forms, h**3 * volume, shear, lame)
    return LawConstants(mass, edge_stiffness(volume * made_of.spring, h), np.empty(0), cells)


def stiffness_of_solid(net: Topology, springs: SpringNet, h: float, cells: SolidCells) -> Floats:
    """Return the stiffness (s,) [N/m] of the springs whose L bounds a solid."""
    pairs = np.broadcast_to(laplacians(WHOLE[None], np.ones(1)), (len(net.cells), 8, 8))
    cut = np.flatnonzero((cells.forms != WHOLE).any(axis=1))
    if len(cut):
        pairs = pairs.copy()
        pairs[cut] = bounding_laplacians(cells.forms[cut], cells.volume[cut] / h**3)
    # (2 mu + 3 lambda) |grad u|^2 bounds the second variation at rest
    return _sums_of_springs(net, springs, -h * (2 * cells.shear + 3 * cells.lame), pairs)


def _forms(fills: Rows, moments: Rows) -> tuple[Rows, Floats, Indices]:
    """Return the strain forms (d, 13) and volumes (d,) [cells] of cells, and which are cut."""
    # whole cells share one row
    forms, cut = np.broadcast_to(WHOLE, (len(fills), len(WHOLE))), (fills < 1).any(axis=1)
    if cut.any():
        forms = forms.copy()
        forms[cut] = forms_of(fills[cut], moments[cut])
    return forms, fills.mean(axis=1), np.flatnonzero(cut)


def _sums_of_springs(net: Topology, springs: SpringNet, values: Floats, weights: Rows) -> Floats:
    """Return, for each spring (s,), the weighted sum of ``values`` (d,) of the cells that share it.

    The order of the sum is the same on all ranks.

    weights : (d, 8, 8) weight of a cell's value for the spring between two of its corners
    """
    sums = _sums_by_slot(net.cells, values, weights, net.copy, len(net.octants))
    return sums.ravel()[springs.slot]


@njit()
def _sums_by_slot(cells: Indices, values: Floats, weights: Rows, copy: Array, owned: int) -> Rows:
    copies = copy.max() + 1
    sums = np.zeros((owned, 27 * copies))
    for i, cell in enumerate(cells):
        for a in range(8):
            if cell[a] < owned:
                for b in range(8):
                    slot = copies * DIRECTION[a, b] + copy[cell[b]]
                    sums[cell[a], slot] += values[i] * weights[i, a, b]
    return sums
