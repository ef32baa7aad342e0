"""Formatting of measured numbers: 34 ms, 1.2e-3, 9,897."""

from typing import Any

PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}
GAP = "\N{NO-BREAK SPACE}"  # a unit stays with its number


def prefixed(value: float, unit: str = "") -> str:
    """Return a number to three digits with the prefix of its unit: 34100 Pa -> 34.1 kPa."""
    power = int(f"{value:.2e}".partition("e")[2]) // 3 * 3
    power = min(max(power, min(PREFIXES)), max(PREFIXES))
    gap = GAP if unit else ""
    return f"{value / 10**power:.3g}{gap}{PREFIXES[power]}{unit}"


def seconds(value: float) -> str:
    """Return a time with its prefix: 0.0341 -> 34.1 ms; no kiloseconds."""
    return prefixed(value, "s") if value < 999.5 else f"{float(f'{value:.3g}'):,.0f}{GAP}s"


def error(value: float) -> str:
    """Return a relative error: 0.00123 -> 1.2e-3, 0.001 -> 1e-3."""
    mantissa, _, exponent = f"{value:.1e}".partition("e")
    return f"{mantissa.removesuffix('.0')}e{int(exponent)}"


def count(value: float) -> str:
    """Return a count: 9897 -> 9,897; a mean keeps one digit."""
    return f"{value:,.0f}" if value == int(value) else f"{value:,.1f}"


def plain(value: float | str | None) -> str:
    """Return an entry of the table with four digits; an empty text for None and NaN."""
    if isinstance(value, str):
        return value
    if value is None or value != value:
        return ""
    return f"{value:.0f}" if value == int(value) and abs(value) < 1e15 else f"{value:.4g}"


TIMES = ("least", "greatest", "step", "substep", "seconds")  # beside the columns time_...


def worded(column: str, value: Any) -> str:
    """Return an entry formatted by the name of its column: an error, a time, memory, a count or a text."""
    if isinstance(value, str) or value is None or value != value:
        return plain(value)
    if column.endswith("error"):
        return error(value)
    if column.startswith("memory"):
        return prefixed(value, "B")
    if column.startswith("time_") or column in TIMES:
        return seconds(value)
    return count(value) if value == int(value) else plain(value)


def entry(row: dict[str, Any], column: str) -> str:
    """Return an entry of a row with the name of its column; empty where it has none."""
    text = worded(column, row[column])
    return f"{column.replace('_', ' ')} {text}" if text else ""
