"""Sizing: errors from runs of several sizes, and the cheapest split of an error among cells, time step and solution."""

import math
from dataclasses import replace

import pytest

from msmpetsc.study.plan import Candidate
from msmpetsc.study.sizing.choice import Budget, Model, Solving, Stepping
from msmpetsc.study.sizing.orders import CELL_ORDERS, ErrorLaw, error_law


@pytest.mark.parametrize("order", [1.2, 1.6, 2.0])
@pytest.mark.parametrize("sizes", [(4, 2, 1), (4.3, 1.9, 1)])
def test_three_sizes_tell_order_and_error(order: float, sizes: tuple):
    """The error is 0.03 size^order exactly."""
    e = [0.03 * size**order for size in sizes]
    law = error_law(sizes, [e[0] - e[1], e[1] - e[2]], CELL_ORDERS)
    assert law.seen and law.order == pytest.approx(order) and law.error(0.5) == pytest.approx(0.03 * 0.5**order)
    assert law.size(law.error(0.7)) == pytest.approx(0.7)


def test_an_order_that_cannot_be_is_not_believed():
    """Distances that do not shrink have no order: the least is taken, which makes the error the greatest."""
    stuck = error_law((4, 2, 1), [0.05, 0.05], CELL_ORDERS)
    assert not stuck.seen and stuck.order == 1 and stuck.error(1) == pytest.approx(0.05)
    steep = error_law((4, 2, 1), [0.5, 0.01], CELL_ORDERS)
    assert steep.order == 2.2 and steep.error(1) == pytest.approx(0.01 / (2**2.2 - 1))
    two = error_law((2, 1), [0.05], CELL_ORDERS)
    assert not two.seen and two.error(1) == pytest.approx(0.05)


def stepping(integrator: str, step: float, error: float, cost: float) -> Stepping:
    return Stepping(Candidate(integrator, step, "newton", "", 1e-3), error, cost)


EULER = [stepping("implicit-euler", 0.01 / 2**k, 0.32 / 2**k, 2.0**k) for k in range(8)]
BDF2 = [stepping("bdf2", 0.01 / 2**k, 0.08 / 4**k, 2.0**k) for k in range(5)]
SOLVINGS = [Solving(1e-1, 0.02, 0.7), Solving(1e-2, 0.002, 1.0), Solving(1e-3, 0.0002, 1.3)]
MODEL = Model(
    ErrorLaw(2.0, 2.0), [*EULER, *BDF2], SOLVINGS, cells=1000, costs=[(100, 1.0), (1000, 10.0)], least=100, most=10**6
)


def test_the_cheapest_split_is_that_of_all_splits():
    """Whatever else is tried, nothing that meets the error is cheaper."""
    choice = MODEL.cheapest(0.03)
    assert choice.budget.total <= 0.03 and choice.method.integrator == "bdf2"
    assert choice.budget.cells == pytest.approx(2 * choice.cells ** (-2 / 3))
    for each in MODEL.steppings:
        for solving in SOLVINGS:
            for cells in range(100, 40_000, 100):
                other = MODEL.choice(each, solving, cells)
                assert other.budget.total > 0.03 or other.cost >= choice.cost


def test_a_smaller_error_costs_more_and_none_is_promised_that_cannot_be():
    costs = [MODEL.cheapest(target).cost for target in (0.1, 0.03, 0.01)]
    assert costs == sorted(costs) and costs[0] < costs[-1]
    few = replace(MODEL, most=1000)
    assert few.cheapest(0.01) is None and few.best().cells == 1000
    assert few.best().budget.cells == pytest.approx(0.02)
    assert replace(MODEL, steppings=EULER[:2]).cheapest(0.1) is None


def test_cells_are_not_fewer_than_were_tried():
    assert MODEL.cheapest(0.9).cells == MODEL.least


def test_explicit_steps_are_not_solved():
    model = replace(MODEL, steppings=[stepping("verlet", 0.01, 1e-4, 3.0)])
    choice = model.cheapest(0.03)
    assert (
        choice.method.step_error is None and choice.budget.step == 0 and choice.shares.time == choice.shares.step == 0
    )


def test_shares_of_the_cost_say_what_a_smaller_error_would_cost():
    """Cost goes as error^-1.5 by cells of order 2, as error^-1/2 by BDF2's steps, and by log 1.3 of the solution."""
    parts = (1.5, 0.5, math.log10(1.3))
    shares = MODEL.choice(BDF2[1], SOLVINGS[1], 1000).shares
    assert (shares.cells, shares.time, shares.step) == pytest.approx([part / sum(parts) for part in parts])
    assert Budget(0.1, 0.2, 0.3).total == pytest.approx(0.6)


def test_cost_grows_with_cells_as_measured():
    """Read off the lattices; beyond them as between the last two, but in proportion to the cells at least."""
    model = replace(MODEL, costs=[(100, 1.0), (800, 2.0), (6400, 20.0)])
    assert model.growth(800, 6400) == pytest.approx(10) and model.growth(800, 100) == pytest.approx(0.5)
    assert model.growth(6400, 8 * 6400) == pytest.approx(10)
    assert replace(MODEL, costs=[(100, 1.0), (800, 1.1)]).growth(800, 8000) == pytest.approx(10)
    assert replace(MODEL, costs=[(100, 1.0)]).growth(100, 300) == pytest.approx(3)
