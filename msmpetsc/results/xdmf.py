"""Write the XDMF 3 file by which ParaView opens a result; the data stay in the result file."""

from collections.abc import Iterator
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from msmpetsc.backend.arrays import Floats
from msmpetsc.fields import FRAME_FIELDS, STRESS
from msmpetsc.results.disk import whole_file
from msmpetsc.results.reader import Result

NUMBER_TYPES = {"f": "Float", "i": "Int", "u": "UInt"}
HEAD = '<?xml version="1.0" encoding="utf-8"?>\n<Xdmf Version="3.0"><Domain>'


def write_xdmf(h5_path: str | Path) -> Path:
    """Write x.xdmf beside x.h5 for its finished frames, and return its path. Raises InputError.

    The file has two temporal collections: the surface triangles, if the surface was stored, and the
    lattice cells, with any stored stress. Both have displacement and velocity.
    """
    h5_path = Path(h5_path)
    path = h5_path.with_suffix(".xdmf")
    with (
        Result(h5_path) as run,
        whole_file(path) as part,
        open(part, "w", encoding="utf-8", errors="xmlcharrefreplace") as file,
    ):
        # line by line, because a long run has 4 kB a frame
        file.writelines(f"{line}\n" for line in _lines(run))
    return path


def _lines(run: Result) -> Iterator[str]:
    """Yield the lines of the file."""
    yield HEAD
    if "surface" in run.frames:
        yield from _collection(run, "surface", "Triangle", "surface/triangles", "surface")
    yield from _collection(run, "lattice", "Hexahedron", "lattice/cells", "position")
    yield "</Domain></Xdmf>"


def _collection(run: Result, name: str, kind: str, elements: str, points: str) -> Iterator[str]:
    """Yield the lines of a collection of grids, one for each finished frame.

    kind   : XDMF's topology type
    points : name of the field of point positions
    """
    yield f'<Grid Name="{name}" GridType="Collection" CollectionType="Temporal">'
    topology = f'<Topology TopologyType="{kind}" NumberOfElements="{len(run[elements])}">'
    topology += f"{_data(run, elements)}</Topology>"
    times = run.frames.time[:]
    centres = {"lattice/cell_kind": "Cell", f"{name}/body": "Node"}
    same = [
        _attribute(of.partition("/")[2], "Scalar", centre, _data(run, of))
        for of, centre in centres.items()
        if of.startswith(name) and of in run
    ]
    for index, time in enumerate(times):
        yield f'<Grid Name="{name} {index}" GridType="Uniform">'
        yield f'<Time Value="{float(time)!r}"/>'
        yield topology
        yield f'<Geometry GeometryType="XYZ">{_slab(run, points, index)}</Geometry>'
        yield from same
        yield from _motion(run, points, index, times)
        if name == "lattice":
            yield from _stress(run, index)
        yield "</Grid>"
    yield "</Grid>"


def _motion(run: Result, points: str, index: int, times: Floats) -> Iterator[str]:
    """Yield displacement and velocity of a frame, which readers compute from positions.

    The velocity is a central difference between frames, or one-sided at either end.
    """
    rows = run.frames[points].shape[1]
    at_rest = _data(run, FRAME_FIELDS[points].at_rest)
    moved = _function("$0 - $1", f"{rows} 3", [_slab(run, points, index), at_rest])
    before, after = max(index - 1, 0), min(index + 1, len(times) - 1)
    passed = float(times[after] - times[before])
    # VTK's functions know no exponents in numbers
    rate = np.format_float_positional(1 / passed if passed else 0.0, trim="0")
    ends = [_slab(run, points, end) for end in (after, before)]
    velocity = _function(f"($0 - $1) * {rate}", f"{rows} 3", ends)
    yield _attribute("displacement", "Vector", "Node", moved)
    yield _attribute("velocity", "Vector", "Node", velocity)


def _stress(run: Result, index: int) -> Iterator[str]:
    """Yield the attributes of a frame's stress.

    A tensor becomes two vectors, because readers of XDMF differ in the order of its components.
    """
    for name in filter(run.frames.__contains__, STRESS):
        centre = "Cell" if "c" in FRAME_FIELDS[name].shape else "Node"
        if run.frames[name].ndim == 3:
            for part, first in (("normal", 0), ("shear", 3)):
                yield _attribute(f"{name}_{part}", "Vector", centre, _slab(run, name, index, first))
        else:
            yield _attribute(name, "Scalar", centre, _slab(run, name, index))


def _attribute(name: str, sort: str, centre: str, item: str) -> str:
    """Return an attribute of a grid, with the reference ``item`` to its values."""
    return f'<Attribute Name="{name}" AttributeType="{sort}" Center="{centre}">{item}</Attribute>'


def _function(formula: str, size: str, arguments: list[str]) -> str:
    """Return a reference to the values of a formula, which the reader computes."""
    head = f'<DataItem ItemType="Function" Function="{formula}" Dimensions="{size}">'
    return "".join([head, *arguments, "</DataItem>"])


def _slab(run: Result, name: str, index: int, first: int = 0) -> str:
    """Return a reference to a frame of a field: start, stride, count and dataset.

    first : first of the three columns to take from a field of vectors or tensors

    The comment names the slab in VTK's cache.
    """
    more = run.frames[name].ndim == 3
    size = f"{run.frames[name].shape[1]}" + " 3" * more
    select = f"{index} 0{f' {first}' * more} 1 1{' 1' * more} 1 {size}"
    return (
        f'<DataItem ItemType="HyperSlab" Dimensions="{size}" Type="HyperSlab">'
        f"<!-- {index}, {first} of {name} -->"
        f'<DataItem Dimensions="3 {2 + more}" Format="XML">{select}</DataItem>'
        f"{_data(run, f'frames/{name}')}</DataItem>"
    )


def _data(run: Result, name: str) -> str:
    """Return a reference to a whole dataset, by file name, so that both files can be moved."""
    array, place = run[name], escape(f"{run.path.name}:/{name}")
    kind, shape = NUMBER_TYPES[array.dtype.kind], " ".join(map(str, array.planned))
    head = f'<DataItem Format="HDF" NumberType="{kind}" Precision="{array.dtype.itemsize}"'
    return f'{head} Dimensions="{shape}">{place}</DataItem>'
