"""VTKHDF with time steps: what ParaView 5.12, VTK 9.3 and pyvista read without a plugin.

A file of version 2.0 (the VTK File Formats, VTKHDF): topology and data that stay as they are stand once, and all steps
point at them; points and data of the steps follow each other.
"""

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from msmpetsc.output.export.moments import Moments

VERSION = (2, 0)
HEXAHEDRON = 12  # VTK's number of the cell type
UNUSED = ("Vertices", "Lines", "Strips")  # of PolyData's four topologies
TOPOLOGIES = ("Vertices", "Lines", "Polygons", "Strips")


def write_vtkhdf(moments: Moments, path: Path) -> None:
    """Write the frames as PolyData of the surface or as an UnstructuredGrid of the lattice."""
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF", track_order=True)
        of_surface = moments.mesh == "surface"
        root.attrs["Version"] = np.array(VERSION)
        root.attrs["Type"] = np.bytes_("PolyData" if of_surface else "UnstructuredGrid")  # fixed length, as VTK asks
        root["NumberOfPoints"] = np.array([len(moments.rest)])
        if of_surface:
            _polygons(root, moments.cells)
        else:
            _topology(root, moments.cells)
            root["Types"] = np.full(len(moments.cells), HEXAHEDRON, np.uint8)
        _steps(root, moments, len(TOPOLOGIES) if of_surface else 1)
        _constant(root, "PointData", moments.constant_data_of_points(), len(moments.frames))
        _constant(root, "CellData", moments.constant_data_of_cells(), len(moments.frames))
        for number, frame in enumerate(moments.frames):
            _append(root, "", {"Points": moments.points(frame)}, number, len(moments.frames))
            _append(root, "PointData", moments.data_of_points(frame), number, len(moments.frames))
            _append(root, "CellData", moments.data_of_cells(frame), number, len(moments.frames))


def _polygons(root: h5py.Group, triangles: np.ndarray) -> None:
    """Write the triangles, and that there is nothing else."""
    for name in TOPOLOGIES:
        _topology(root.create_group(name), np.empty((0, 3), np.int64) if name in UNUSED else triangles)


def _topology(group: h5py.Group, cells: np.ndarray) -> None:
    """Write cells of one kind, (c, k) corner points."""
    group["NumberOfCells"] = np.array([len(cells)])
    group["NumberOfConnectivityIds"] = np.array([cells.size])
    group["Connectivity"] = cells.ravel()
    group["Offsets"] = cells.shape[1] * np.arange(len(cells) + 1)


def _steps(root: h5py.Group, moments: Moments, topologies: int) -> None:
    """Write the times, and that every step has the first part's topology and points of its own."""
    count, steps = len(moments.frames), root.create_group("Steps")
    steps.attrs["NSteps"] = count
    steps["Values"] = moments.times
    steps["PartOffsets"] = np.zeros(count, np.int64)
    steps["NumberOfParts"] = np.ones(count, np.int64)
    steps["PointOffsets"] = len(moments.rest) * np.arange(count)
    for name in ("CellOffsets", "ConnectivityIdOffsets"):
        steps[name] = np.zeros((count, topologies), np.int64)
    for group in ("PointData", "CellData"):
        root.create_group(group)
        steps.create_group(f"{group}Offsets")


def _constant(root: h5py.Group, group: str, data: dict[str, np.ndarray], count: int) -> None:
    """Write data of all steps once."""
    for name, values in data.items():
        root[group][name] = values
        root["Steps"][f"{group}Offsets"][name] = np.zeros(count, np.int64)


def _append(root: h5py.Group, group: str, data: dict[str, np.ndarray], number: int, count: int) -> None:
    """Write data of a step after those of the steps before."""
    holder: Any = root[group] if group else root
    for name, values in data.items():
        if name not in holder:
            shape = (count * len(values), *values.shape[1:])
            holder.create_dataset(name, shape, values.dtype)
            if group:
                root["Steps"][f"{group}Offsets"][name] = len(values) * np.arange(count)
        holder[name][number * len(values) : (number + 1) * len(values)] = values
