"""Cells and springs of a lattice as they are drawn: the half behind the body's middle, so that the inside is seen."""

from dataclasses import dataclass

import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.output.drawing.camera import Camera
from msmpetsc.output.drawing.colours import BOUNDARY_CELL, INTERIOR_CELL, SPRING
from msmpetsc.output.drawing.subject import Subject

SHOWN = ("cells", "springs")
BOUNDARY, INTERIOR = 1, 2  # lattice/cell_kind
SHRUNK = 0.86  # of a cell's size, so that neighbours are told apart
THROUGH = 0.3  # opacity of a body whose lattice is shown
FACES = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])  # VTK's order
KINDS = {BOUNDARY: (BOUNDARY_CELL, "boundary cell"), INTERIOR: (INTERIOR_CELL, "interior cell")}


@dataclass(frozen=True)
class Fabric:
    """Faces (f, 4) or lines (s, 2) between points (p, 3) [m], of one colour."""

    points: np.ndarray
    joined: np.ndarray
    colour: str


@dataclass(frozen=True)
class Cut:
    """What is left of the lattice when the half before its middle is taken away.

    cells   : (c, 8) by their kind
    springs : (s, 2), both ends of which lie behind
    """

    cells: dict[int, np.ndarray]
    springs: np.ndarray

    def fabric(self, nodes: np.ndarray) -> tuple[Fabric, ...]:
        """Return cells and springs at positions (n, 3) of the nodes."""
        parts = [_cells(nodes, cells, KINDS[kind][0]) for kind, cells in self.cells.items()]
        return (*parts, Fabric(nodes, self.springs, SPRING)) if len(self.springs) else tuple(parts)


def cut_open(subject: Subject, camera: Camera, shown: tuple[str, ...]) -> Cut:
    """Return the half of the lattice behind the middle of the body at rest. Raises InputError where there is none."""
    if not len(subject.rest.cells):
        raise InputError(f"--show: {subject.name} is a mesh without cells")
    nodes, cells = subject.rest.nodes, subject.rest.cells
    depth = nodes @ camera.to_eye
    middle = (depth.min() + depth.max()) / 2
    behind = depth[cells].mean(axis=1) <= middle
    kind = subject.array("lattice/cell_kind")
    parts = {number: cells[behind & (kind == number)] for number in KINDS} if "cells" in shown else {}
    springs = np.empty((0, 2), int)
    if "springs" in shown:
        springs = subject.springs
        springs = springs[(depth[springs] <= middle).all(axis=1)]
    return Cut({number: part for number, part in parts.items() if len(part)}, springs)


def _cells(nodes: np.ndarray, cells: np.ndarray, colour: str) -> Fabric:
    corners = nodes[cells]
    middles = corners.mean(axis=1, keepdims=True)
    points = (middles + SHRUNK * (corners - middles)).reshape(-1, 3)
    faces = (8 * np.arange(len(cells))[:, None, None] + FACES).reshape(-1, 4)
    return Fabric(points, faces, colour)
