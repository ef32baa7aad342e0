"""Measured numbers as a reader wants them: 34 ms, 1.2e-3, 9,897. What is missing, None or NaN, is an empty text."""

from collections.abc import Callable
from functools import wraps
from typing import Any

PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}
GAP = "\N{NO-BREAK SPACE}"  # a unit stays with its number


def _or_nothing(word: Callable[[Any], str]) -> Callable[[Any], str]:
    """Make a function return an empty text for what is missing."""

    @wraps(word)
    def worded(value: Any) -> str:
        return "" if value is None or value != value else word(value)

    return worded


def prefixed(value: float, unit: str = "") -> str:
    """Return a number to three digits with the prefix of its unit: 34100 Pa -> 34.1 kPa."""
    power = int(f"{value:.2e}".partition("e")[2]) // 3 * 3
    power = min(max(power, min(PREFIXES)), max(PREFIXES))
    gap = GAP if unit else ""
    return f"{value / 10**power:.3g}{gap}{PREFIXES[power]}{unit}"


@_or_nothing
def seconds(value: float) -> str:
    """Return a time with its prefix: 0.0341 -> 34.1 ms; no kiloseconds."""
    return prefixed(value, "s") if value < 999.5 else f"{float(f'{value:.3g}'):,.0f}{GAP}s"


@_or_nothing
def error(value: float) -> str:
    """Return a relative error: 0.00123 -> 1.2e-3, 0.001 -> 1e-3."""
    mantissa, _, exponent = f"{value:.1e}".partition("e")
    return f"{mantissa.removesuffix('.0')}e{int(exponent)}"


@_or_nothing
def count(value: float) -> str:
    """Return a number of things: 9897 -> 9,897; means keep a digit."""
    return f"{value:,.0f}" if value == int(value) else f"{value:,.1f}"


@_or_nothing
def size(value: float) -> str:
    """Return bytes with their prefix: 2.5e8 -> 250 MB."""
    return prefixed(value, "B")


@_or_nothing
def plain(value: float | str) -> str:
    """Return any entry of the table, numbers to four digits."""
    if isinstance(value, str):
        return value
    return f"{value:.0f}" if value == int(value) and abs(value) < 1e15 else f"{value:.4g}"


SETTINGS: dict[str, tuple[str, Callable[[Any], str]]] = {  # columns that a reader tells cases apart by: their words
    "error": ("error {}", error),
    "max_iterations": ("{} iterations", count),
    "cells": ("{} cells", count),
    "ranks": ("{} ranks", count),
}


def setting(row: dict[str, Any], name: str) -> str:
    """Return a setting of the case of a row in words; empty where it has none."""
    text, word = SETTINGS[name]
    return text.format(word(row[name])) if row[name] else ""


def stepping(row: dict[str, Any]) -> str:
    """Return how the case of a row steps; an explicit one has substeps within its time step, that between frames."""
    if row["integrator"] == "verlet":
        return f"substeps of {seconds(row['substep'])}" if row["substep"] else "longest stable substeps"
    return f"time step {seconds(row['time_step'])}" if row["time_step"] else ""
