"""Progress of a study: a line for each case that is done, with the time that is left."""

import sys
from collections.abc import Sequence
from time import monotonic
from typing import TextIO

from msmpetsc.results.progress_bar import duration
from msmpetsc.study.table import Row


class StudyProgress:
    """Shows each case that is done.

    work : of each case still to do, in any unit
    done : cases that were done before
    """

    def __init__(self, work: Sequence[float], done: int = 0, stream: TextIO | None = None):
        self._total, self._done = done + len(work), done
        self._left, self._spent = sum(work), 0.0
        self._stream = stream or sys.stderr
        self._begun = monotonic()
        if done:
            self._print(f"{done} of {self._total} cases are done already")

    def update(self, row: Row, work: float) -> None:
        """Show a case that is done."""
        self._done, self._left, self._spent = self._done + 1, self._left - work, self._spent + work
        left = duration((monotonic() - self._begun) * self._left / self._spent)
        self._print(f"case {self._done}/{self._total}  {described(row)}  {_outcome(row)}  {left} left")

    def _print(self, line: str) -> None:
        print(line, file=self._stream, flush=True)


def described(row: Row) -> str:
    """Return a case in a few words."""
    if row.get("map"):
        x = "" if row["x"] == row["label"] else f"{row['x']}, "
        return f"{row['map']} {row['label']} at {x}{row['y']}"
    parts = [row["scene"], row["label"], f"{row['cells']:.0f} cells" if row["cells"] else ""]
    parts.append(f"t = {row['substep'] or row['time_step']:.3g} s")
    if row["error"]:
        parts.append(f"error {row['error']:g}")
    elif row["max_iterations"]:
        parts.append(f"{row['max_iterations']} iterations")
    return " ".join(filter(None, parts))


def _outcome(row: Row) -> str:
    if row.get("map"):
        return row["outcome"]
    if row["status"] != "ok":
        return f"{row['status']}: {row['reason']}"
    errors = {"step": row.get("true_error"), "trajectory": row.get("trajectory_error")}
    reached = [f"{name} error {value:.1e}" for name, value in errors.items() if value is not None]
    time = row.get("time_frame")
    low, high = row.get("time_frame_min"), row.get("time_frame_max")
    range_of_repeats = f" ({low:.3g} to {high:.3g})" if low is not None and high is not None else ""
    stepping = f"{time:.3g} s a step{range_of_repeats}" if time else "no step"
    return "  ".join([stepping, *reached, *filter(None, [row["reason"]])])
