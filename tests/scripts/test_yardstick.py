"""scripts/yardstick.py: coarse sizes against published values, within bounds from theory."""

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
    found = [
        (value.name, case.error(value, x), case.bound(value))
        for value, x in zip(case.value, run.ours, strict=True)
    ]
    assert all(abs(error) <= bound for _, error, bound in found), found


def test_there_are_24_public_cases_each_with_a_source_and_a_theory():
    public = [case for case in CASES if not case.own]
    assert len(public) >= 24 and len({case.name for case in CASES}) == len(CASES)
    assert all(case.source and case.theory and 0 < case.fast <= len(case.sizes) for case in CASES)
    assert all(peer.source for case in CASES for peer in case.peer)


def test_the_page_has_every_value_within_its_bound_and_explains_deviations_over_two_percent():
    """No finer size exceeds the bound of the coarse size that the tests run."""
    rows = re.findall(r"^\| (\d+) \|(.*)\|$", PAGE.read_text(), re.MULTILINE)
    values = [(case, value) for case in CASES for value in case.value]
    assert len(rows) == len(values)
    for (_, row), (case, value) in zip(rows, values, strict=True):
        cells = [cell.strip() for cell in row.split("|")]
        name = case.name if value is case.value[0] else ""
        assert cells[:3] == [name, value.name, f"{case.reference(value):.5g}"]
        shown = cells[4].replace("exact", "0%").split(" · ")
        errors = [abs(float(error.rstrip("%"))) / 100 for error in shown]
        assert errors[-1] < 0.02 or value.note, (case, value)
        # The page has two digits
        bound = 1.05 * case.bound(value)
        assert max(errors[case.fast - 1 :]) <= bound, (case.name, value, bound)
