"""The XDMF 3 file beside a result: it lets ParaView open the frames and holds no data itself."""

import xml.etree.ElementTree as ET
from pathlib import Path

from msmpetsc.results.disk import write_whole
from msmpetsc.results.reader import Result

NUMBER_TYPES = {"f": "Float", "i": "Int", "u": "UInt"}


def write_xdmf(h5_path: str | Path) -> Path:
    """Write x.xdmf beside x.h5 once that is closed, and return its path. Raises InputError.

    Two temporal collections: the surface triangles, where the surface was stored, and the lattice cells.
    """
    h5_path = Path(h5_path)
    root = ET.Element("Xdmf", Version="3.0")
    domain = ET.SubElement(root, "Domain")
    with Result(h5_path) as run:
        if "frames/surface" in run:
            _collection(domain, "surface", "Triangle", run, "surface/triangles", "frames/surface")
        for grid in _collection(domain, "lattice", "Hexahedron", run, "lattice/cells", "frames/position"):
            kind = ET.SubElement(grid, "Attribute", Name="cell_kind", AttributeType="Scalar", Center="Cell")
            kind.append(_data_item(run, "lattice/cell_kind"))
    ET.indent(root)
    path = h5_path.with_suffix(".xdmf")
    write_whole(path, ET.tostring(root, encoding="utf-8", xml_declaration=True))
    return path


def _collection(domain: ET.Element, name: str, kind: str, run: Result, elements: str, points: str) -> list[ET.Element]:
    """Add one grid a finished frame: `elements` of topology `kind` on `points` (T, n, 3). Return the grids."""
    collection = ET.SubElement(domain, "Grid", Name=name, GridType="Collection", CollectionType="Temporal")
    grids = []
    for index, time in enumerate(run.frames.time[:]):
        grid = ET.SubElement(collection, "Grid", Name=f"{name} {index}", GridType="Uniform")
        ET.SubElement(grid, "Time", Value=repr(float(time)))
        topology = ET.SubElement(grid, "Topology", TopologyType=kind, NumberOfElements=str(len(run[elements])))
        topology.append(_data_item(run, elements))
        geometry = ET.SubElement(grid, "Geometry", GeometryType="XYZ")
        geometry.append(_frame_slab(run, points, index))
        if f"{name}/body" in run:
            body = ET.SubElement(grid, "Attribute", Name="body", AttributeType="Scalar", Center="Node")
            body.append(_data_item(run, f"{name}/body"))
        grids.append(grid)
    return grids


def _frame_slab(run: Result, points: str, index: int) -> ET.Element:
    """Return frame `index` of points (T, n, 3): start, stride, count, and the dataset."""
    _, rows, axes = run[points].shape
    item = ET.Element("DataItem", ItemType="HyperSlab", Dimensions=f"{rows} {axes}", Type="HyperSlab")
    item.append(ET.Comment(f"frame {index}"))  # VTK takes the first thing in it for its name, and caches points by that
    part = ET.SubElement(item, "DataItem", Dimensions="3 3", Format="XML")
    part.text = f"{index} 0 0  1 1 1  1 {rows} {axes}"
    item.append(_data_item(run, points))
    return item


def _data_item(run: Result, name: str) -> ET.Element:
    """Return a reference to a whole dataset, by its file's name alone so that both files can move together."""
    array = run[name]
    item = ET.Element(
        "DataItem",
        Format="HDF",
        NumberType=NUMBER_TYPES[array.dtype.kind],
        Precision=str(array.dtype.itemsize),
        Dimensions=" ".join(map(str, array.planned)),
    )
    item.text = f"{run.path.name}:/{name}"
    return item
