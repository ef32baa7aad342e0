"""The frames of a result as an xarray.Dataset: coordinates, units, long names; read where it is used."""

from typing import TYPE_CHECKING

from msmpetsc.errors import InputError
from msmpetsc.output.lazy import LazyArray

if TYPE_CHECKING:
    from msmpetsc.output.reader import Result

DIMENSIONS = {"position": ("time", "node", "axis"), "surface": ("time", "point", "axis"), "momentum": ("time", "axis")}
LONG_NAMES = {
    "time": "simulated time",
    "position": "node positions",
    "surface": "surface points",
    "rest_position": "node positions at rest",
    "rest_surface": "surface points at rest",
    "mass": "mass of a node",
    "step_error": "estimated relative error of a step",
    "true_error": "true relative error of a step, in position",
    "energy_error": "true relative error of a step, in energy",
    "iterations": "outer iterations",
    "ksp_its": "iterations of the linear solver",
    "kinetic": "kinetic energy",
    "elastic": "elastic energy",
    "potential": "energy in gravity and forces",
    "contact": "energy in the push of obstacles",
    "momentum": "momentum",
    "wall_time": "computing time",
    "inverted": "cells turned inside out",
    "substeps": "shorter steps taken in place of whole ones",
    "fallbacks": "steps solved by the robust method",
    "energy_gained": "energy that came from nowhere",
}
# What stands beside the frames: name in the dataset, dimensions, group and name in the file.
AT_REST = (
    ("rest_position", ("node", "axis"), "lattice", "nodes"),
    ("mass", ("node",), "lattice", "mass"),
    ("rest_surface", ("point", "axis"), "surface", "points"),
)


def labelled(result: "Result"):
    """``result.frames`` by name over (time, node | point, axis); the lattice at rest among the coordinates."""
    try:
        import xarray
    except ImportError as error:  # also of what xarray itself needs
        raise InputError(f"to_xarray needs the package xarray: pip install xarray ({error})") from None

    def variable(name: str, dimensions: tuple[str, ...], array: LazyArray):
        about = {"long_name": LONG_NAMES.get(name, name.replace("_", " ")), "units": array.unit}
        return xarray.Variable(dimensions, _when_used(array), about)

    def of_frames(name: str) -> tuple[str, ...]:
        more = [f"{name}_{axis}" for axis in range(1, result.frames[name].ndim)]
        return DIMENSIONS.get(name) or ("time", *more)

    variables = {name: variable(name, of_frames(name), array) for name, array in result.frames.items()}
    groups = {"lattice": result.lattice, "surface": result.surface}
    coordinates = {
        name: variable(name, dimensions, groups[group][its_name])
        for name, dimensions, group, its_name in AT_REST
        if its_name in groups[group]
    }
    coordinates |= {"time": variables.pop("time").load(), "axis": ("axis", ["x", "y", "z"])}
    return xarray.Dataset(variables, coordinates, result.attributes)


def _when_used(array: LazyArray):
    """As xarray's own readers of files do it."""
    from xarray.backends import BackendArray
    from xarray.core import indexing

    class OfAResult(BackendArray):
        shape, dtype = array.shape, array.dtype

        def __getitem__(self, key):
            basic = indexing.IndexingSupport.BASIC
            return indexing.explicit_indexing_adapter(key, self.shape, basic, array.__getitem__)

    return indexing.LazilyIndexedArray(OfAResult())
