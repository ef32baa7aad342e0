"""Operations of the loops over springs, counted by numbers that count."""

import math
from collections.abc import Callable
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from lattices import one_spring

from msmpetsc.elasticity import energy, springs

COUNTED = "spring_pull", "spring_change", "spring_block", "block_product"


class Number(float):
    """A number that counts each operation which makes another of it."""

    made = 0

    @classmethod
    def of(cls, value: float) -> "Number":
        cls.made += 1
        return cls(value)


def counts(act: Callable[[float, float], float]) -> Callable[[Number, float], Number]:
    return lambda a, b: Number.of(act(a, float(b)))


for name in ("add", "radd", "sub", "rsub", "mul", "rmul", "truediv", "rtruediv"):
    setattr(Number, f"__{name}__", counts(getattr(float, f"__{name}__")))


@pytest.fixture
def counting(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The loops without numba."""
    for name in COUNTED:
        monkeypatch.setattr(springs, name, getattr(springs, name).py_func)
    monkeypatch.setattr(springs, "math", SimpleNamespace(sqrt=lambda x: Number.of(math.sqrt(x))))
    monkeypatch.setattr(springs, "max", lambda a, b: Number.of(a if a > b else b), raising=False)
    monkeypatch.setattr(Number, "made", 0)
    return springs


def numbers(*shape: int) -> np.ndarray:
    values = np.arange(1.0, 1 + math.prod(shape)) ** 2
    return np.array([Number(value) for value in values], object).reshape(shape)


@pytest.mark.parametrize("stiffens", [0, 1])
@pytest.mark.parametrize("name", ["gradient", "change", "hessian"])
def test_operations_of_a_spring(counting: ModuleType, name: str, stiffens: int):
    q, ends, r, k = numbers(2, 3), np.array([[0, 1]]), numbers(1), numbers(1)
    spring, law = (q, ends, r, k, Number(0.5 * stiffens)), getattr(energy, name.upper())
    if name == "gradient":
        counting.add_elastic_gradient.py_func(*spring, numbers(2, 3))
        twice = 3  # f (p_a - p_b), which a compiler keeps
        assert Number.made - twice == law[0] + stiffens * law[1]
    elif name == "change":
        counting.elastic_change.py_func(q, q * q, *spring[1:])
        moved = 3 * 2 + 6  # a node's, not a spring's; and q * q, above
        assert Number.made - moved == law[0] + stiffens * law[1]
    else:
        counting.elastic_hessian.py_func(*spring, False, np.empty((1, 4), object))
        assert Number.made == law[0] + stiffens * law[1]


def test_operations_of_a_product(counting: ModuleType):
    v = numbers(2, 3).view(Typed)
    counting.add_elastic_product.py_func(np.array([[0, 1]]), numbers(1, 4), v, numbers(2, 3))
    sums = 3  # of the first end, once for all its springs
    assert Number.made - sums == energy.PRODUCT


class Typed(np.ndarray):
    """Whose type makes such numbers."""

    @property
    def dtype(self) -> SimpleNamespace:
        return SimpleNamespace(type=Number)


def test_a_lattice_has_those_of_its_springs_and_nodes():
    counts = energy.Flops.of_lattice(one_spring(1.0, 1.0, 1.0))
    assert (counts.gradient, counts.change, counts.hessian, counts.product) == (22 + 30, 38 + 72, 20, 23 + 18)
