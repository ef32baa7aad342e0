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
from msmpetsc.model.lattice import CORNERS, Lattice
from msmpetsc.model.material import CellMaterial
from msmpetsc.scene.body import Material, PartTable, Region

EDGE = 1e-9  # of the body's longest side: a node this near to a region counts as on its edge, whatever was rounded


@dataclass(frozen=True)
class Finder:
    """Finds a region's nodes in a body's lattice, or its cells.

    folder : where files of painted points lie
    """

    body: Body
    cages: Cages
    folder: Path

    def find(self, key: str, region: Region, lattice: Lattice) -> np.ndarray:
        """Return the local nodes that a region means, (l,) bool (collective).

        key : of the region's table in the scene, for messages. Raises InputError on all ranks if there are none.
        """
        if region.painted is None:
            where = inside(region, lattice.nodes, self.body.bounds)
        else:
            where = self._corners_of(self._painted_cells(key, region.painted), lattice)
        if self.body.comm.allreduce(int(where[: lattice.owned].sum())) == 0:
            raise InputError(f"{key}.region holds no node of the lattice")
        return where

    def find_cells(self, key: str, region: Region, ijk: np.ndarray) -> np.ndarray:
        """Return which cells (c,) bool have their centres in a region, or hold a painted point (collective).

        ijk : (c, 3) grid index of the cells. Raises InputError on all ranks if the region means none.
        """
        if region.painted is None:
            where = inside(region, self.cages.grid.node_positions(ijk + 0.5), self.body.bounds)
        else:
            where = np.isin(encode_morton(ijk), encode_morton(self._painted_cells(key, region.painted)))
        if not self.body.comm.allreduce(bool(where.any()), MPI.LOR):
            raise InputError(f"{key}.region holds the centre of no cell")
        return where

    def _painted_cells(self, key: str, painted: str | tuple[int, ...]) -> np.ndarray:
        """Return the cells (k, 3) that painted points of the surface lie in (collective)."""

        def cells() -> np.ndarray:
            assert self.body.surface is not None  # it is on rank 0, which alone is asked
            points, numbers = self.body.surface.points, np.array(self._numbers(key, painted))
            if numbers.max() >= len(points):
                raise InputError(
                    f"{key}.region.painted: there is no point {numbers.max()}: the surface has {len(points)}"
                )
            return np.unique(self.cages.grid.to_cells(points[numbers]).astype(np.int64), axis=0)

        return self.body.comm.bcast(on_root(self.body.comm, cells))

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

    def _corners_of(self, cells: np.ndarray, lattice: Lattice) -> np.ndarray:
        keys = np.unique(encode_morton(cells[:, None, :] + CORNERS))
        return np.isin(encode_morton(self.cages.grid.nearest_nodes(lattice.nodes)), keys)


def inside(region: Region, points: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return which points (n, 3) [m] lie in a region or on its edge, (n,) bool.

    bounds : (2, 3) the body's bounding box at rest [m]
    """
    sides = bounds[1] - bounds[0]
    origin, scale, length = (bounds[0], sides, sides.max()) if region.relative else (np.zeros(3), np.ones(3), 1.0)
    edge = EDGE * sides.max()

    def to_body(point: tuple[float, ...]) -> np.ndarray:
        return origin + np.asarray(point) * scale

    if region.box is not None:
        low, high = region.box
        return ((points >= to_body(low) - edge) & (points <= to_body(high) + edge)).all(axis=1)
    if region.sphere is not None:
        distance = np.linalg.norm(points - to_body(region.sphere.center), axis=1)
        return distance <= region.sphere.radius * length + edge
    assert region.half_space is not None  # the schema has one of the four, and the painted ones are not asked for
    return (points - to_body(region.half_space.point)) @ np.asarray(region.half_space.normal) >= -edge


def cell_materials(
    material: Material, parts: tuple[PartTable, ...], finder: Finder
) -> Callable[[np.ndarray], CellMaterial] | None:
    """Return the function from the grid index (c, 3) of cells to what they are made of (collective).

    It is None where all cells are of the same material.
    """
    if not parts:
        return None
    (spring,) = (name for name in Material.one_of if getattr(material, name) is not None)

    def of_cells(ijk: np.ndarray) -> CellMaterial:
        cells = CellMaterial(np.full(len(ijk), material.density), np.full(len(ijk), getattr(material, spring)))
        for number, part in enumerate(parts):
            where = finder.find_cells(f"part.{number}", part.region, ijk)
            cells.density[where] = part.density or cells.density[where]
            cells.spring[where] = getattr(part, spring) or cells.spring[where]
        return cells

    return of_cells
