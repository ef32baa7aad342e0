"""Parts of a body that are of another material, cell by cell."""

from collections.abc import Callable

import numpy as np

from msmpetsc.model.material import CellMaterial
from msmpetsc.model.region import Finder
from msmpetsc.scene.schema import Material, Part


def cell_materials(
    material: Material, parts: tuple[Part, ...], finder: Finder
) -> Callable[[np.ndarray], CellMaterial] | None:
    """From the grid index (c, 3) of cells to what they are made of; None where all are of the same (collective)."""
    if not parts:
        return None
    (spring,) = (name for name in Material.one_of if getattr(material, name) is not None)

    def of_cells(ijk: np.ndarray) -> CellMaterial:
        found = CellMaterial(np.full(len(ijk), material.density), np.full(len(ijk), getattr(material, spring)))
        for number, part in enumerate(parts):
            where = finder.find_cells(f"part.{number}", part.region, ijk)
            found.density[where] = part.density or found.density[where]
            found.spring[where] = getattr(part, spring) or found.spring[where]
        return found

    return of_cells
