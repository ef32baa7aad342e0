"""The choice of steps by an account of their errors, without a body; and their allowed times."""

from collections.abc import Callable

import pytest

from msmpetsc.solve.integrators.adaptive import Measure, StepControl, Ticks

STEP, STEPS, LEVELS = 0.01, 400, (-10, 6)


def control(order: int, error: float, levels: tuple[int, int] = LEVELS) -> StepControl:
    return StepControl(order, error, STEP, STEP * STEPS, levels)


def march(
    control: StepControl, rate: Callable[[float], float], until: float = 1.0
) -> list[tuple[float, int]]:
    """Return start and level of each step of a motion of size 1.

    Local errors are t^(order + 1) times the greater rate at the ends of a step.
    """
    ticks, tick, taken = Ticks(STEP, STEPS, LEVELS[0], []), 0, []
    while tick < until * ticks.ticks:
        level, start = ticks.fitting(tick, control.level), ticks.time(tick)
        hardest = max(rate(start), rate(ticks.time(tick + ticks.length(level))))
        measure = Measure(hardest * (STEP * 2.0**level) ** (control.order + 1), 1.0)
        if control.accepts(level, measure):
            control.pay(level, measure)
            taken.append((start, level))
            tick += ticks.length(level)
    return taken


def test_what_an_even_flight_saves_is_spent_on_the_impact_after_it():
    """After an even flight, steps of the impact are longer than in a run that is all impact."""

    def rate(time: float) -> float:
        return 100.0 if 1.9 < time < 2.5 else 1e-6

    account, all_impact = control(2, 1e-2), control(2, 1e-2)
    levels, worst = march(account, rate), march(all_impact, lambda _: 100.0)
    assert account.estimate < 1.5e-2
    assert max(level for time, level in levels if time < 1.9) > 3
    during, usual = ([level for time, level in run if 1.9 < time < 2.5] for run in (levels, worst))
    assert max(during[2:]) < 1 and len(during) < 0.7 * len(usual)


def test_no_moment_takes_all_the_steps():
    """A moment of 1e6 times the rate takes at most twenty times the steps of the rest."""
    account = control(2, 1e-2)
    levels = march(account, lambda time: 1e6 if 2.0 <= time <= 2.1 else 1.0)
    assert len(levels) < 20 * len(march(control(2, 1e-2), lambda _: 1.0))
    assert account.estimate < 3e-2


def test_a_step_too_far_off_is_taken_again_shorter_but_for_the_shortest():
    account = control(2, 1e-2, (-3, 0))
    far = Measure(1e-2, 1.0)
    assert not account.accepts(0, far) and account.level < 0
    assert not account.accepts(-2, Measure(float("nan"), 1.0)) and account.level == -3
    assert account.accepts(-3, far) and account.spent == 0
    account.pay(-3, far)
    assert account.spent == far.error
    assert not account.shorten(-3)


def test_steps_start_at_multiples_of_themselves_and_end_at_events_and_at_the_end():
    ticks = Ticks(STEP, 10, -4, [0.03, 0.0556, 7.0])
    assert ticks.length(0) == 16 and ticks.time(3 * 16) == pytest.approx(0.03)
    # two steps fit, but half of the next two would pass the event
    assert ticks.fitting(0, 6) == 1
    assert ticks.fitting(2 * 16, 1) == 0
    assert ticks.fitting(3 * 16 + 1, 6) == -4
    assert ticks.is_event(3 * 16) and not ticks.is_event(3 * 16 + 1)
    tick, ends = 0, []
    while tick < ticks.ticks:
        level = ticks.fitting(tick, 6)
        assert tick % ticks.length(level) == 0
        tick += ticks.length(level)
        ends.append(tick)
    assert {3 * 16, round(0.0556 / STEP * 16)} <= set(ends) and ends[-1] == 10 * 16


def test_a_step_looks_at_few_of_many_events():
    looks = []

    class Watched(list[int]):
        def __getitem__(self, index):
            looks.append(index)
            return super().__getitem__(index)

        def __iter__(self):
            return (self[index] for index in range(len(self)))

    ticks = Ticks(STEP, 10_000, 0, [STEP * number for number in range(10_000)])
    ticks.events = Watched(ticks.events)
    assert ticks.fitting(9000, 6) == 0 and ticks.is_event(9000)
    assert 0 < len(looks) < 100
