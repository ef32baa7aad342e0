"""Numbers with the word of a unit, "300 mm", in place of numbers in SI units.

Which unit a key has is what its description names in brackets, [m]; which words go with that unit stands in ``WORDS``.
"""

import re
from collections.abc import Mapping
from decimal import Decimal
from typing import Any

from pydantic.fields import FieldInfo
from pydantic_core import InitErrorDetails

from msmpetsc.scene.problems import KeyPath, rule

WORDS: dict[str, dict[str, str]] = {  # a key's unit -> the words for it, and what each is in that unit
    "m": {"mm": "1e-3", "cm": "1e-2", "m": "1", "km": "1e3", "in": "0.0254"},
    "s": {"ms": "1e-3", "s": "1", "min": "60"},
    "Pa": {"Pa": "1", "kPa": "1e3", "MPa": "1e6", "GPa": "1e9"},
    "kg/m^3": {"kg/m^3": "1", "g/cm^3": "1e3"},
    "N": {"mN": "1e-3", "N": "1", "kN": "1e3"},
}
BRACES, BRACKETS = re.compile(r"\{.*?\}"), re.compile(r"\[([^]]+)\]")
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?"
QUANTITY = re.compile(rf"\s*({NUMBER})\s*(?![eE][-+\d])([^\W\d][^\s]{{0,20}})\s*", re.ASCII)
LONGEST = 60  # characters of a number and its word


def units_of(description: str) -> list[str]:
    """Return the units that a description names in brackets, each once; those within braces are of an example."""
    return list(dict.fromkeys(BRACKETS.findall(BRACES.sub("", description))))


def words_of(description: str) -> Mapping[str, str]:
    """Return the words that a key of this description may have behind its numbers; none for most units."""
    return next((WORDS[unit] for unit in units_of(description) if unit in WORDS), {})


def is_quantity(value: Any) -> bool:
    """Return whether a value is a number with a word, or a list or table that has one."""
    if isinstance(value, dict | list | tuple):
        return any(map(is_quantity, value.values() if isinstance(value, dict) else value))
    return isinstance(value, str) and len(value) <= LONGEST and QUANTITY.fullmatch(value) is not None


def in_si(data: Any, fields: Mapping[str, FieldInfo]) -> tuple[Any, list[InitErrorDetails]]:
    """Return a table's data with numbers in place of those with words, and the problems of words that do not fit.

    A value without a number and a word stays as it is, and so does that of a key whose unit has no words.
    """
    if not isinstance(data, dict):
        return data, []
    plain, problems = dict(data), list[InitErrorDetails]()
    for name, value in data.items():
        words = words_of(fields[name].description or "") if name in fields else {}
        if words and not isinstance(value, dict):
            plain[name] = _number(value, words, (name,), problems)
    return plain, problems


def _number(value: Any, words: Mapping[str, str], loc: KeyPath, problems: list[InitErrorDetails]) -> Any:
    """Return the number that a value means, or its items; problems are added to the list."""
    if isinstance(value, list | tuple):
        return [_number(item, words, (*loc, number), problems) for number, item in enumerate(value)]
    quantity = QUANTITY.fullmatch(value) if is_quantity(value) else None
    if quantity is None:
        return value
    number, word = quantity.groups()
    if word in words:
        return float(Decimal(number) * Decimal(words[word]))  # of decimals, so that "300 mm" is the double 0.3
    *others, last = words
    allowed = f"must be a number, or one with {', '.join(others)} or {last}"
    problems.append(InitErrorDetails(type=rule(allowed), loc=loc, input=value))
    return value


def with_numbers(data: Any, checked: Any) -> Any:
    """Return data as TOML has it, with the numbers of the checked tables in place of those with words."""
    if isinstance(data, dict):
        inner = checked if isinstance(checked, dict) else vars(checked)
        return {key: with_numbers(value, inner[key]) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [with_numbers(*pair) for pair in zip(data, checked, strict=True)]
    return checked if isinstance(data, str) and isinstance(checked, float) else data
