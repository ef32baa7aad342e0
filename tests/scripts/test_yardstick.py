"""scripts/yardstick.py: coarse sizes against published values, by bounds from theory; its page."""

import re

import pytest
import yardstick
from conftest import ROOT
from yardstick import Case

CASES = yardstick.cases()
PAGE = ROOT / "scripts" / "results" / "yardstick.md"


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_a_coarse_size_is_as_near_as_theory_says(case: Case):
    run = yardstick.measured(case, case.sizes[case.fast - 1])
    errors = {v.name: case.error(v, x) for v, x in zip(case.value, run.ours, strict=True)}
    bounds = {value.name: value.within for value in case.value}
    assert all(abs(error) <= bounds[name] for name, error in errors.items()), errors


def test_there_are_24_public_cases_each_with_a_source_and_a_theory():
    public = [case for case in CASES if not case.own]
    assert len(public) >= 24 and len({case.name for case in CASES}) == len(CASES)
    assert all(case.source and case.theory and 0 < case.fast <= len(case.sizes) for case in CASES)


def test_the_page_has_every_value_and_explains_each_deviation_over_two_percent():
    rows = re.findall(r"^\| (\d+) \|(.*)\|$", PAGE.read_text(), re.MULTILINE)
    values = [(case, value) for case in CASES for value in case.value]
    assert len(rows) == len(values)
    for (_, row), (case, value) in zip(rows, values, strict=True):
        cells = [cell.strip() for cell in row.split("|")]
        assert cells[:3] == [
            case.name if value is case.value[0] else "",
            value.name,
            f"{case.reference(value):.5g}",
        ]
        last = cells[4].rpartition(" · ")[2]
        assert last == "exact" or abs(float(last.rstrip("%"))) < 2 or value.note, (case, value)
