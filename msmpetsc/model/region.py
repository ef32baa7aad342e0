"""Which nodes or cells a scene means by a region, and the materials of the parts that regions make."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mpi4py import MPI

from msmpetsc.comm import on_root
from msmpetsc.errors import InputError
from msmpetsc.geometry.cages import Body, Cages
from msmpetsc.geometry.grid import encode_morton
from msmpetsc.geometry.inside import inside_bodies
from msmpetsc.model.lattice import CORNERS, Lattice
from msmpetsc.model.material import CellMaterial
from msmpetsc.scene.bodies import OfBody
from msmpetsc.scene.body import Material
from msmpetsc.scene.schema import Scene


@dataclass(frozen=True)
class Finder:
    """Finds a region's nodes in the lattice of bodies, or its cells.

    folder : where files of painted points lie
    """

    bodies: tuple[Body, ...]
    cages: Cages
    folder: Path

    @property
    def comm(self) -> MPI.Comm:
        return self.bodies[0].comm

    @property
    def bounds(self) -> np.ndarray:
        """Bounding box at rest (b, 2, 3) [m] of each body."""
        return np.array([body.bounds for body in self.bodies])

    def find(self, table: OfBody, lattice: Lattice) -> np.ndarray:
        """Return the local nodes that the region of a scene's table means, (l,) bool (collective).

        Raises InputError on all ranks if there are none.
        """
        region = table.table.region
        if region.painted is None:
            where = inside_bodies(region, lattice.nodes, self.bounds, lattice.body, table.body)
        else:
            keys = np.unique(encode_morton(self._painted_cells(table)[:, None, :] + CORNERS))
            nodes = self.cages.grids.nearest_nodes(lattice.nodes, lattice.body)
            where = np.isin(encode_morton(nodes), keys)
        if self.comm.allreduce(int(where[: lattice.owned].sum())) == 0:
            raise InputError(f"{table.key}.region holds no node of the lattice")
        return where

    def find_cells(self, table: OfBody, ijk: np.ndarray) -> np.ndarray:
        """Return which cells (c,) bool have their centres in a region, or hold a painted point (collective).

        ijk : (c, 3) grid index of the cells. Raises InputError on all ranks if the region means none.
        """
        region, grids = table.table.region, self.cages.grids
        if region.painted is None:
            centres = grids.node_positions(ijk + 0.5)
            where = inside_bodies(region, centres, self.bounds, grids.body_of(ijk), table.body)
        else:
            where = np.isin(encode_morton(ijk), encode_morton(self._painted_cells(table)))
        if not self.comm.allreduce(bool(where.any()), MPI.LOR):
            raise InputError(f"{table.key}.region holds the centre of no cell")
        return where

    def _painted_cells(self, table: OfBody) -> np.ndarray:
        """Return the cells (k, 3) that painted points of a body's surface lie in (collective)."""
        key, number = table.key, table.body or 0  # without a body there is but one: the scene's own
        surface, grid = self.bodies[number].surface, self.cages.grids.grids[number]

        def cells() -> np.ndarray:
            assert surface is not None  # it is on rank 0, which alone is asked
            points, numbers = surface.points, np.array(self._numbers(key, table.table.region.painted))
            if numbers.max() >= len(points):
                raise InputError(
                    f"{key}.region.painted: there is no point {numbers.max()}: the surface has {len(points)}"
                )
            return np.unique(grid.to_cells(points[numbers]).astype(np.int64), axis=0)

        return self.comm.bcast(on_root(self.comm, cells)) + self.cages.grids.first(number)

    def _numbers(self, key: str, painted: str | tuple[int, ...]) -> list[int]:
        if not isinstance(painted, str):
            return list(painted)
        path = self.folder / painted
        try:
            if path.exists() and not path.is_file():
                raise InputError(f"{key}.region.painted: {path} is not a file of numbers")
            numbers = [int(word) for word in path.read_text().split()]
        except OSError as error:
            raise InputError(f"{key}.region.painted: {path} cannot be read: {error.strerror}") from None
        except ValueError:
            raise InputError(f"{key}.region.painted: {path} is no list of whole numbers") from None
        if not numbers or not 0 <= min(numbers) <= max(numbers) < 2**63:
            raise InputError(f"{key}.region.painted: {path} must list point numbers, from 0")
        return numbers


def cell_materials(scene: Scene, finder: Finder) -> Callable[[np.ndarray], CellMaterial] | None:
    """Return the function from the grid index (c, 3) of cells to what they are made of (collective).

    It is None where all cells are of the same material.
    """
    material, parts, bodies = scene.material, list(scene.tables("part")), [body.material for body in scene.body]
    if not parts and not any(bodies):
        return None
    (spring,) = (name for name in Material.one_of if getattr(material, name) is not None)
    density, stiffness = (
        np.array([getattr(own, name, None) or getattr(material, name) for own in bodies or [None]])
        for name in ("density", spring)
    )

    def of_cells(ijk: np.ndarray) -> CellMaterial:
        body = finder.cages.grids.body_of(ijk)
        cells = CellMaterial(density[body], stiffness[body])
        for part in parts:
            where = finder.find_cells(part, ijk)
            cells.density[where] = part.table.density or cells.density[where]
            cells.spring[where] = getattr(part.table, spring) or cells.spring[where]
        return cells

    return of_cells
