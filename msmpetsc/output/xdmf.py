"""The XDMF 3 file beside a result: it lets ParaView open the frames and holds no data itself."""

import os
import xml.etree.ElementTree as ET
from pathlib import Path

import h5py

from msmpetsc.output.reader import checked_dataset, damage_told, finished, open_result

NUMBER_TYPES = {"f": "Float", "i": "Int", "u": "UInt"}


def write_xdmf(h5_path: str | Path) -> Path:
    """Write x.xdmf beside x.h5, to be called once that is closed; returns its path.

    Two temporal collections: the surface triangles, where the surface was stored, and the lattice cells.
    """
    h5_path = Path(h5_path)
    root = ET.Element("Xdmf", Version="3.0")
    domain = ET.SubElement(root, "Domain")
    with open_result(h5_path) as file, damage_told(h5_path):
        names = ["lattice/cells", "frames/position", "lattice/cell_kind"]
        names += ["surface/triangles", "frames/surface"] if "surface" in file["frames"].keys() else []
        cells, positions, kinds, *surface = (checked_dataset(h5_path, file, name) for name in names)
        if surface:
            _collection(domain, "surface", "Triangle", *surface)
        for grid in _collection(domain, "lattice", "Hexahedron", cells, positions):
            kind = ET.SubElement(grid, "Attribute", Name="cell_kind", AttributeType="Scalar", Center="Cell")
            kind.append(_data_item(kinds))
    ET.indent(root)
    path = h5_path.with_suffix(".xdmf")
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    ET.ElementTree(root).write(part, encoding="utf-8", xml_declaration=True)
    os.replace(part, path)
    return path


def _collection(
    domain: ET.Element, name: str, kind: str, elements: h5py.Dataset, points: h5py.Dataset
) -> list[ET.Element]:
    """One grid a finished frame: `elements` of topology `kind` on `points` (T, n, 3). Returns the grids."""
    file = points.file
    collection = ET.SubElement(domain, "Grid", Name=name, GridType="Collection", CollectionType="Temporal")
    grids = []
    for index, time in enumerate(file["frames/time"][: finished(file)]):
        grid = ET.SubElement(collection, "Grid", Name=f"{name} {index}", GridType="Uniform")
        ET.SubElement(grid, "Time", Value=repr(float(time)))
        topology = ET.SubElement(grid, "Topology", TopologyType=kind, NumberOfElements=str(len(elements)))
        topology.append(_data_item(elements))
        geometry = ET.SubElement(grid, "Geometry", GeometryType="XYZ")
        geometry.append(_one_frame(points, index))
        grids.append(grid)
    return grids


def _one_frame(points: h5py.Dataset, index: int) -> ET.Element:
    """Frame `index` of (T, n, 3): start, stride and count along each axis, then where to take it from."""
    _, rows, axes = points.shape
    item = ET.Element("DataItem", ItemType="HyperSlab", Dimensions=f"{rows} {axes}", Type="HyperSlab")
    part = ET.SubElement(item, "DataItem", Dimensions="3 3", Format="XML")
    part.text = f"{index} 0 0  1 1 1  1 {rows} {axes}"
    item.append(_data_item(points))
    return item


def _data_item(dataset: h5py.Dataset) -> ET.Element:
    """A reference to the whole dataset, by its file's name alone so that both files can move together."""
    item = ET.Element(
        "DataItem",
        Format="HDF",
        NumberType=NUMBER_TYPES[dataset.dtype.kind],
        Precision=str(dataset.dtype.itemsize),
        Dimensions=" ".join(map(str, dataset.shape)),
    )
    item.text = f"{Path(dataset.file.filename).name}:{dataset.name}"
    return item
