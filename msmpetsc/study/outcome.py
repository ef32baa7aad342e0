"""How a run of a map went, in a word: from the worst to the best."""

from collections import Counter
from collections.abc import Iterable

from msmpetsc.study.table import Row

OUTCOMES = (
    "crashed", "timeout", "refused", "not finite", "energy", "diverged", "not recovered", "inverted", "slow", "ok",
)  # fmt: skip
MEANING = {
    "crashed": "the program itself broke",
    "timeout": "took too long",
    "refused": "the program would not begin",
    "not finite": "a number overflowed",
    "energy": "the energy grew without work",
    "diverged": "a step not solved, or explicit steps ran away",
    "not recovered": "more than 2% off the rest shape at the end",
    "inverted": "cells are inside out at the end",
    "slow": "more than 30 iterations a step",
    "ok": "none of these",
}
STEP_FAILED, REFUSED = 3, 2  # exit statuses
OWN_NAME = ("not finite", "energy", "refused")  # kinds of failure that are outcomes
RECOVERED = 0.02  # shape error
SLOW = 30  # iterations a step


def outcome(status: int | None, kind: str, row: Row, recovers: bool) -> str:
    """status: exit status, None where time ran out; kind: of the failure that the run tells of, "" for none;
    row: its figures; recovers: whether it should have ended in its rest shape."""
    if status is None:
        return "timeout"
    if status == REFUSED:
        return "refused"
    if status == STEP_FAILED:
        return kind if kind in OWN_NAME else "diverged"
    if status != 0 or not row.get("frames"):
        return "crashed"
    shape = row.get("shape_error")
    if shape is None:
        return "not finite"
    if recovers and shape > RECOVERED:
        return "not recovered"
    if (row.get("inverted") or 0) > 0:
        return "inverted"
    solved = row.get("integrator") != "verlet"  # whose iterations are substeps
    return "slow" if solved and (row.get("iterations") or 0) > SLOW else "ok"


def counted(rows: Iterable[Row]) -> str:
    """How many went how, best first: 20 ok, 3 slow."""
    found = Counter(row["outcome"] for row in rows)
    return ", ".join(f"{found[name]} {name}" for name in reversed(OUTCOMES) if found[name])
