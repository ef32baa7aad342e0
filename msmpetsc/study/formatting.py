"""Formatting of measured numbers with digits, prefixes and units: 34 ms, 1.2e-3, 9,897."""

from typing import Any

PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}
# separator of number and unit; it prevents a line break
GAP = "\N{NO-BREAK SPACE}"


def prefixed(value: float, unit: str = "") -> str:
    """Return a number with three digits and a prefix to its unit: 34100, "Pa" -> 34.1 kPa."""
    power = int(f"{value:.2e}".partition("e")[2]) // 3 * 3
    power = min(max(power, min(PREFIXES)), max(PREFIXES))
    gap = GAP if unit else ""
    return f"{value / 10**power:.3g}{gap}{PREFIXES[power]}{unit}"


def seconds(value: float) -> str:
    """Return a time in seconds or smaller units: 0.0341 -> 34.1 ms, 5432.1 -> 5,430 s."""
    return prefixed(value, "s") if value < 999.5 else f"{float(f'{value:.3g}'):,.0f}{GAP}s"


def error(value: float) -> str:
    """Return a relative error with two digits: 0.00123 -> 1.2e-3, 0.001 -> 1e-3."""
    mantissa, _, exponent = f"{value:.1e}".partition("e")
    return f"{mantissa.removesuffix('.0')}e{int(exponent)}"


def count(value: float) -> str:
    """Return a count with thousands separated, 9897 -> 9,897; a mean keeps a decimal digit."""
    return f"{value:,.0f}" if value == int(value) else f"{value:,.1f}"


def plain(value: float | str | None) -> str:
    """Return a table entry as text with four digits; "" for None and NaN."""
    if isinstance(value, str):
        return value
    if value is None or value != value:
        return ""
    return f"{value:.0f}" if value == int(value) and abs(value) < 1e15 else f"{value:.4g}"


# columns in seconds whose names do not begin with time_
TIMES = ("least", "greatest", "step", "substep", "seconds")


def worded(column: str, value: Any) -> str:
    """Return an entry as text: an error, bytes, a time or a count, by the column's name."""
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
    """Return "name value" of an entry of a row, "" if the entry is missing."""
    text = worded(column, row[column])
    return f"{column.replace('_', ' ')} {text}" if text else ""
