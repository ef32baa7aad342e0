"""Materials of cells in the parts of a scene, and mean materials in cells that an interface cuts.

Samples stand for the part of a cell inside the surface. A cell that an interface cuts has the
means of E, nu and rho over its samples. So uniform strain has the energy of the materials. Bending
also depends on where in the cell the stiff material is. So the fills and second moments of the cell
are weighted by stiffness, with w = E / mean E at the samples:

    s_v = 8 int w N_v,      int w x^2,      N_v the trilinear function of a corner.

With a single material w is 1. If one of two materials has no stiffness, the cell is like a cell
that the surface cuts (lattice.cut_cells, lattice.cell_moments).
"""

from collections.abc import Iterable, Sequence

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Mask, Rows
from msmpetsc.lattice.cell_samples import COUNT, CellSamples
from msmpetsc.lattice.material import CellMaterial, MaterialOfCells, MixedCells
from msmpetsc.lattice.region import Finder
from msmpetsc.scene.body import Material, OwnMaterial
from msmpetsc.scene.schema import OfBody


def cell_materials(
    material: Material,
    bodies: Sequence[OwnMaterial | None],
    part_tables: Iterable[OfBody],
    finder: Finder,
) -> MaterialOfCells | None:
    """Return a collective function from keys (c,) of cells to their materials.

    Return None if all cells have the scene's material.

    bodies : own material of each body that has a table
    """
    parts = list(part_tables)
    if not parts and not any(bodies):
        return None
    (spring,) = (name for name in Material.one_of if getattr(material, name) is not None)
    names = "density", spring, "poisson_ratio"
    of_bodies = [
        np.array([_own(own, material, name) for own in bodies or [None]]) for name in names
    ]

    def of_cells(keys: Indices) -> CellMaterial:
        cells = CellSamples(finder.cages, keys)
        masks = [finder.find_samples(part, cells) for part in parts]
        is_cut = np.zeros(len(keys), bool)
        for mask in masks:
            is_cut |= mask.any(axis=1) & ~mask.all(axis=1)
        cut = np.flatnonzero(is_cut)
        shares = finder.shares_inside(cells, cut)
        for part, mask in zip(parts, masks, strict=True):
            mask[cut] &= shares > 0
            finder.check_holds(part, mask)
        (density, _), (stiffness, of_samples), (poisson, _) = (
            _means([getattr(x.table, name) for x in parts], masks, of_body[cells.body], cut, shares)
            for name, of_body in zip(names, of_bodies, strict=True)
        )
        weights = shares * (of_samples / stiffness[cut, None] - 1)
        rows = np.flatnonzero(weights.any(axis=1))
        weighted = cells.weighted(cut[rows], weights[rows])
        return CellMaterial(density, stiffness, poisson, MixedCells(cut[rows], *weighted))

    return of_cells


def _means(
    values: Sequence[float | None],
    masks: Sequence[Mask],
    of_cells: Floats,
    cut: Indices,
    shares: Rows,
) -> tuple[Floats, Rows]:
    """Return a constant of cells (c,), and of the samples (k, s) of the cells ``cut`` (k,).

    A cell that an interface between materials cuts has the mean over its samples.

    values   : value of each part, None if the part gives none; the last part takes effect
    masks    : mask (c, s) of each part's samples
    of_cells : (c,) value outside the parts; changed to the result
    shares   : (k, s) share of each sample in the cells ``cut``
    """
    of_samples = np.repeat(of_cells[cut, None], COUNT, axis=1)
    for value, mask in zip(values, masks, strict=True):
        if value is not None:
            of_cells[mask.all(axis=1)] = value
            of_samples[mask[cut]] = value
    # relative to a sample inside, so that equal samples give exactly their value
    first = np.take_along_axis(of_samples, shares.argmax(axis=1)[:, None], axis=1)
    of_cells[cut] = first[:, 0] + (shares * (of_samples - first)).sum(axis=1)
    return of_cells, of_samples


def _own(own: OwnMaterial | None, material: Material, name: str) -> float:
    """Return a constant of a body's own material, or of the scene's if the body gives none."""
    value: float | None = getattr(own, name, None)
    return float(getattr(material, name)) if value is None else value
