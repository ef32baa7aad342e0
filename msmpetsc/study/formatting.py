"""Measured numbers as a reader wants them: 34 ms, 1.2e-3, 9,897."""

from matplotlib.ticker import EngFormatter

GAP = "\N{NO-BREAK SPACE}"  # a unit stays with its number


def seconds(value: float | None) -> str:
    """A time with its prefix: 0.0341 -> 34.1 ms; no kiloseconds."""
    if value is None:
        return ""
    rounded = float(f"{value:.3g}")
    return EngFormatter("s", sep=GAP)(rounded) if rounded < 1000 else f"{rounded:,.0f}{GAP}s"


def error(value: float | None) -> str:
    """A relative error: 0.00123 -> 1.2e-3, 0.001 -> 1e-3."""
    if value is None:
        return ""
    mantissa, _, exponent = f"{value:.1e}".partition("e")
    return f"{mantissa.removesuffix('.0')}e{int(exponent)}"


def count(value: float | None) -> str:
    """A number of things: 9897 -> 9,897; means keep a digit."""
    return "" if value is None else f"{value:,.0f}" if value == int(value) else f"{value:,.1f}"


def size(value: float | None) -> str:
    """Bytes with their prefix: 2.5e8 -> 250 MB."""
    return "" if value is None else EngFormatter("B", sep=GAP)(float(f"{value:.3g}"))


def plain(value: float | str | None) -> str:
    """Any entry of the table, numbers to four digits."""
    if value is None or isinstance(value, str):
        return value or ""
    return f"{value:.0f}" if value == int(value) and abs(value) < 1e15 else f"{value:.4g}"
