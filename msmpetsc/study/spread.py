"""Spread of the repeats of a case, and which times it leaves apart. From one run alone nothing is known of it."""

from collections.abc import Callable, Iterable

from msmpetsc.study.rows import Row

Cost = Callable[[Row], float]
UNKNOWN = (
    "Each was run once: how much its time varies is not known, so that close times decide nothing; "
    "repeats = 3 would tell."
)


def spread(row: Row, cost: Cost) -> tuple[float, float] | None:
    """Least and greatest of the repeats of a figure in proportion to the time of a step, or to its inverse; None where
    they are not known."""
    least, greatest = row.get("time_frame_min"), row.get("time_frame_max")
    if least is None or greatest is None:
        return None
    return tuple(sorted(cost(row | {"time_frame": time} | derived(row, time)) for time in (least, greatest)))


def derived(row: Row, time: float) -> Row:
    """The figures that follow from the time of a step, for another one [s]."""
    factor = time / row["time_frame"]
    known = {"fps": 1 / factor, "time_second": factor}
    return {name: row[name] * by for name, by in known.items() if row.get(name) is not None}


def is_known(rows: Iterable[Row]) -> bool:
    """Whether each of these was repeated."""
    return all(row.get("time_frame_min") is not None for row in rows)


def ends(row: Row, cost: Cost) -> tuple[float, float]:
    """The spread; where it is not known, twice the figure itself."""
    return spread(row, cost) or (cost(row), cost(row))


def is_below(one: Row, other: Row, cost: Cost) -> bool:
    """Whether all repeats of one were below all of the other."""
    return ends(one, cost)[1] < ends(other, cost)[0]


def within_noise(first: Row, rows: Iterable[Row], cost: Cost) -> list[Row]:
    """Those of the others whose repeats reach the range of the first's, the nearest first, each label once."""
    near = sorted((row for row in rows if not is_below(first, row, cost)), key=cost)
    by_label = {row["label"]: row for row in reversed(near) if row["label"] != first["label"]}
    return sorted(by_label.values(), key=cost)
