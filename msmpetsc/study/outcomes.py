"""Outcome of a run of a stability map, from the exit status and the metrics of the run."""

from collections import Counter
from collections.abc import Iterable
from typing import Any

from msmpetsc.errors import STATUS_FAILED, STATUS_REFUSED
from msmpetsc.study.table import Row

# outcomes of a run of a map and their legend, from the worst to the best
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
OUTCOMES = tuple(MEANING)
# kinds of failure in the measure file that are outcomes under the same name
NAMED_FAILURES = ("not finite", "energy", "refused")
# largest shape error [-] of a body in its rest shape
RECOVERED = 0.02
# iterations per step above which a run is "slow"
SLOW = 30


def outcome(status: int | None, kind: str, row: Row, recovers: bool) -> str:
    """Return the worst outcome of a run, a key of ``MEANING``.

    status   : exit status, None after a timeout
    kind     : kind of failure in the measure file, "" if there is none
    recovers : whether the body should end in its rest shape
    """
    if status is None:
        return "timeout"
    if status == STATUS_REFUSED:
        return "refused"
    if status == STATUS_FAILED:
        return kind if kind in NAMED_FAILURES else "diverged"
    if status != 0 or not row.get("frames"):
        return "crashed"
    shape = row.get("shape_error")
    if shape is None:
        return "not finite"
    if recovers and shape > RECOVERED:
        return "not recovered"
    if (row.get("inverted") or 0) > 0:
        return "inverted"
    # a verlet run reports substeps in place of iterations
    solved = row.get("integrator") != "verlet"
    return "slow" if solved and (row.get("iterations") or 0) > SLOW else "ok"


def counted(outcomes: Iterable[Any]) -> str:
    """Return the number of runs with each outcome, best first: 20 ok, 3 slow."""
    counts = Counter(outcomes)
    return ", ".join(f"{counts[name]} {name}" for name in reversed(OUTCOMES) if counts[name])
