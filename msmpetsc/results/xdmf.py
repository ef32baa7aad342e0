"""The XDMF 3 file of a result, which lets ParaView open the frames and holds no data itself."""

import xml.etree.ElementTree as ET
from pathlib import Path

from msmpetsc.fields import FRAME_FIELDS, STRESS
from msmpetsc.results.disk import write_whole
from msmpetsc.results.reader import Result

NUMBER_TYPES = {"f": "Float", "i": "Int", "u": "UInt"}


def write_xdmf(h5_path: str | Path) -> Path:
    """Write x.xdmf beside x.h5 once that is closed, and return its path. Raises InputError.

    Two temporal collections: the surface triangles, where the surface was stored, and the lattice
    cells with their stress, where that was.
    """
    h5_path = Path(h5_path)
    root = ET.Element("Xdmf", Version="3.0")
    domain = ET.SubElement(root, "Domain")
    with Result(h5_path) as run:
        if "frames/surface" in run:
            _collection(domain, "surface", "Triangle", run, "surface/triangles", "frames/surface")
        grids = _collection(domain, "lattice", "Hexahedron", run, "lattice/cells", "frames/position")
        for grid in grids:
            kind = ET.SubElement(grid, "Attribute", Name="cell_kind", AttributeType="Scalar", Center="Cell")
            kind.append(_data_item(run, "lattice/cell_kind"))
        for name in filter(run.frames.__contains__, STRESS):
            centre = "Cell" if "c" in FRAME_FIELDS[name].shape else "Node"
            is_tensor = run.frames[name].ndim == 3  # as two vectors: XDMF's readers differ in the order of a tensor
            parts = {f"{name}_normal": 0, f"{name}_shear": 3} if is_tensor else {name: None}
            for index, grid in enumerate(grids):
                for part, first in parts.items():
                    sort = "Vector" if is_tensor else "Scalar"
                    field = ET.SubElement(grid, "Attribute", Name=part, AttributeType=sort, Center=centre)
                    field.append(_frame_slab(run, f"frames/{name}", index, first))
    ET.indent(root)
    path = h5_path.with_suffix(".xdmf")
    write_whole(path, ET.tostring(root, encoding="utf-8", xml_declaration=True))
    return path


def _collection(domain: ET.Element, name: str, kind: str, run: Result, elements: str, points: str) -> list[ET.Element]:
    """Add a grid for each finished frame, of topology `kind` on `points` (T, n, 3). Return the grids."""
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


def _frame_slab(run: Result, name: str, index: int, first: int | None = 0) -> ET.Element:
    """Return a reference to frame `index` of a dataset: (T, r, k) from column ``first`` on, or (T, r) with None.

    It is start, stride, count, and the dataset.
    """
    rows = run[name].shape[1]
    columns, start = (f" {rows}", f"{index} 0") if first is None else (f" {rows} 3", f"{index} 0 {first}")
    axes = len(columns.split())
    item = ET.Element("DataItem", ItemType="HyperSlab", Dimensions=columns.strip(), Type="HyperSlab")
    # VTK takes the first thing in it for its name, and caches by that
    item.append(ET.Comment(f"frame {index} of {name}, {first}"))
    part = ET.SubElement(item, "DataItem", Dimensions=f"3 {1 + axes}", Format="XML")
    part.text = f"{start}  1{' 1' * axes}  1{columns}"
    item.append(_data_item(run, name))
    return item


def _data_item(run: Result, name: str) -> ET.Element:
    """Return a reference to a whole dataset by the file's name alone, so that both files can move together."""
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
