"""A pretended GPU: arrays in CPU memory that behave towards NumPy's arrays as CuPy's do.

Bodies of kernels run index by index. Like CuPy's, these arrays raise if they are mixed with NumPy's
arrays or converted to them implicitly. Copies between the devices are counted.
"""

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from petsc4py import PETSc

from msmpetsc.solve.petsc import device

# functions of NumPy that CuPy 13 has, among the functions that the steps call
KNOWN = [
    "array_equal", "asarray", "bincount", "concatenate", "copyto", "cross", "einsum", "empty",
    "empty_like",
    "flatnonzero", "linalg.norm", "nonzero", "tile", "vdot", "where", "zeros", "zeros_like",
]  # fmt: skip
# most numbers in an array that does not grow with a body
FEW = 9
counted = Counter()


def name_of(function) -> str:
    module = function.__module__.partition("numpy.")[2]
    return (
        f"{module}.{function.__name__}"
        if module and not module.startswith("core")
        else function.__name__
    )


class Array(NDArrayOperatorsMixin):
    """CuPy's array, as far as the steps use it."""

    __array_priority__ = 100

    def __init__(self, values: np.ndarray):
        self.values = values

    def __array__(self, *_, **__):
        raise TypeError("Implicit conversion to a NumPy array is not allowed. Please use `.get()`.")

    def __array_ufunc__(self, ufunc, method, *inputs, out=(), **keywords):
        assert method == "__call__", f"CuPy has no {ufunc.__name__}.{method}"
        found = ufunc(
            *map(bare, inputs), **({"out": tuple(map(bare, out))} if out else {}), **keywords
        )
        return out[0] if out else dressed(found)

    def __array_function__(self, function, _, arguments, keywords):
        name = name_of(function)
        assert name in KNOWN, f"has CuPy numpy.{name}?"
        if name in ("asarray", "array"):
            return arguments[0] if isinstance(arguments[0], Array) else send(arguments[0])
        assert not keywords.keys() & {"device", "copy", "initial", "where"}, (
            f"CuPy's {name} may not take all of {keywords}"
        )
        keywords = {key: bare(value) for key, value in keywords.items() if key != "like"}
        return dressed(function(*map(bare, arguments), **keywords))

    def __getitem__(self, key):
        return dressed(self.values[bare(key)])

    def __setitem__(self, key, value):
        mask = isinstance(key, Array) and key.values.dtype == bool
        assert not mask or np.isscalar(value), "CuPy sets no rows by a mask"
        self.values[bare(key)] = bare(value)

    def get(self) -> np.ndarray:
        counted["arrays from the GPU"] += self.values.size > FEW
        return self.values.copy()

    def __float__(self):
        return float(self.values)

    def __int__(self):
        return int(self.values)

    def __bool__(self):
        return bool(self.values)

    def __iter__(self):
        return (self[i] for i in range(len(self)))

    def __len__(self):
        return len(self.values)

    @property
    def __cuda_array_interface__(self) -> dict:
        """Address of the array, as PETSc asks for it."""
        return self.values.__array_interface__

    shape, size, nbytes, dtype, T = (
        property(lambda self: self.values.shape),
        property(lambda self: self.values.size),
        property(lambda self: self.values.nbytes),
        property(lambda self: self.values.dtype),
        property(lambda self: Array(self.values.T)),
    )


def _method(name: str):
    def call(self, *arguments, **keywords):
        return dressed(getattr(self.values, name)(*map(bare, arguments), **keywords))

    return call


for _name in (
    "all",
    "any",
    "argmin",
    "astype",
    "copy",
    "max",
    "mean",
    "min",
    "ravel",
    "reshape",
    "sum",
):
    setattr(Array, _name, _method(_name))


def bare(value):
    """Return the values of the array; raise for NumPy's own arrays."""
    if isinstance(value, Array):
        return value.values
    if isinstance(value, np.ndarray) and value.ndim:
        raise TypeError("Unsupported type <class 'numpy.ndarray'>")
    # NamedTuples are made by _make
    make = getattr(value, "_make", type(value))
    return make(map(bare, value)) if isinstance(value, (tuple, list)) else value


def dressed(value):
    """Return a result as CuPy's: sums and products are arrays without dimensions, not numbers."""
    if isinstance(value, tuple):
        return tuple(map(dressed, value))
    return Array(np.asarray(value)) if isinstance(value, (np.ndarray, np.generic)) else value


class Memory(device.Memory):
    """PETSc's memory on the CPU, seen as arrays of the GPU."""

    def read(self, vector: PETSc.Vec) -> Array:
        return Array(super().read(vector))

    def write(self, vector: PETSc.Vec) -> Array:
        return Array(super().write(vector))

    def over(self, array: Array, comm: PETSc.Comm) -> PETSc.Vec:
        return super().over(array.values, comm)

    def values(self, dense: PETSc.Mat) -> Array:
        return Array(super().values(dense))


def launcher(body):
    def launch(count, *arguments):
        counted["launches"] += 1
        compiled(body)(0, count, 1, *map(bare, arguments))

    return launch


def compiled(body):
    """Return the CPU's form of a body, which ``kernel`` has made already."""
    return getattr(__import__(body.__module__, fromlist=["_"]), body.__name__).compiled


def send(array: np.ndarray) -> Array:
    counted["arrays to the GPU"] += np.size(array) > FEW
    return Array(np.array(array))


@contextmanager
def module(name: str, **contents) -> Iterator[None]:
    """Replace a module by a stand-in of this name.

    patch.dict would also forget modules imported in the meantime.
    """
    before = sys.modules.get(name)
    sys.modules[name] = SimpleNamespace(**contents)
    try:
        yield
    finally:
        sys.modules.pop(name) if before is None else sys.modules.update({name: before})


@contextmanager
def pretended(launch=launcher) -> Iterator[Counter]:
    """Make runs within the context compute on this GPU; yield the counts.

    launch : backend.launcher.launcher
    """
    counted.clear()
    with (
        patch.object(device, "sender", lambda comm: send),
        patch("msmpetsc.solve.simulate.sender", lambda comm: send),
        patch.object(device, "CUDA", Memory()),
        module("msmpetsc.backend.launcher", launcher=launch),
    ):
        yield counted
