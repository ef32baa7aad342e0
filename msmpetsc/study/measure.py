"""A case is run, repeated, and becomes a row."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock

from msmpetsc.errors import InputError
from msmpetsc.study.case import Case, command, shown_command
from msmpetsc.study.metrics import Row, failure, measured, of_frames, rates, together, trace
from msmpetsc.study.outcome import outcome
from msmpetsc.study.process import Ended, Processes
from msmpetsc.study.trajectory import trajectory_error


@dataclass(frozen=True)
class Measured:
    """The row of a case, its trace if one was asked for, and the time all of it took [s]."""

    row: Row
    trace: dict | None
    seconds: float


@dataclass
class Bench:
    """Runs cases in a folder: results come and go in it, references stay."""

    folder: Path
    processes: Processes
    study: str = ""
    _locks: dict[str, Lock] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)

    def measure(self, case: Case) -> Measured:
        """Run a case as often as it says; what goes wrong stands in its row."""
        runs, path, seconds = [], self.folder / "runs" / f"{case.id}.h5", 0.0
        reference, why = self._reference(case)
        found, kind = None, ""
        for repeat in range(case.repeats):
            ended = self._run(case if repeat == 0 else case.unmeasured(), path)
            seconds += ended.seconds
            row, problem = self._figures(case, path, ended)
            if repeat == 0:
                found = trace(path.with_suffix(".json"))
                if reference is not None and not ended.reason:
                    row["trajectory_error"], why = _distance(path, reference)
            kind = failure(path.with_suffix(".json"))
            _forget(path, log=not ended.reason)
            runs.append(row)
            if ended.reason:
                break
            why = why or problem
        status = "ok" if not ended.reason else "timeout" if ended.status is None else "failed"
        row = self._named(case) | together(runs) | {"status": status, "reason": ended.reason or why}
        if case.place:
            row["outcome"] = outcome(ended.status, kind, row, case.place.recovers)
        return Measured(row | rates(row, case.time_step), found, seconds)

    def references(self) -> list[Path]:
        """The results of the references made so far."""
        return sorted((self.folder / "references").glob("*.h5"))

    def _named(self, case: Case) -> Row:
        """What is known before it runs."""
        return naming(case) | {"study": self.study, "command": shown_command(case)}

    def _run(self, case: Case, path: Path) -> Ended:
        path.parent.mkdir(parents=True, exist_ok=True)
        figures, log = path.with_suffix(".json"), path.with_suffix(".log")
        # no time is asked of a place in a map
        return self.processes.run(command(case, path, figures), log, case.timeout, warm=case.place is not None)

    def _figures(self, case: Case, path: Path, ended: Ended) -> tuple[Row, str]:
        """Figures of a run, as far as it came; and what is missing, in words."""
        row, problem = {}, ""
        try:
            row |= measured(path.with_suffix(".json"))
            row |= of_frames(path, case.time_step)
            if case.integrator == "verlet":
                row["estimated_error"] = None  # nothing is solved
        except (OSError, ValueError, InputError) as error:
            problem = "" if ended.reason else f"no figures: {error}"
        return row, problem

    def _reference(self, case: Case) -> tuple[Path | None, str]:
        """The result of the case's reference, made if need be; or why there is none."""
        if case.reference is None:
            return None, ""
        path = self.folder / "references" / f"{case.reference.id}.h5"
        with self._lock:
            lock = self._locks.setdefault(case.reference.id, Lock())
        with lock:
            failed = path.with_suffix(".failed")
            if not path.is_file() and not failed.is_file():
                part = path.with_suffix(".part.h5")
                ended = self._run(case.reference, part)
                if self.processes.stopped:
                    return None, "stopped"
                if ended.reason:
                    failed.write_text(ended.reason)
                else:
                    os.replace(part, path)
                _forget(part, log=not ended.reason)
        return (path, "") if path.is_file() else (None, f"no reference: {failed.read_text()}")


def naming(case: Case) -> Row:
    """The columns that define a case."""
    same = ("scene", "integrator", "preset", "options", "label", "ranks", "repeats", "time_step", "substep", "error")
    row = {name: getattr(case, name) for name in (*same, "max_iterations")}
    if case.place:
        row |= {"map": case.place.map, "x": str(case.place.x), "y": str(case.place.y)}
    return row | {"case": case.id, "cells": case.cells}


def _distance(path: Path, reference: Path) -> tuple[float | None, str]:
    try:
        return trajectory_error(path, reference), ""
    except InputError as error:
        return None, f"no trajectory error: {error}"


def _forget(path: Path, log: bool) -> None:
    """Remove a run's files, large as they are; its log only if ``log``."""
    for suffix in (".h5", ".xdmf", ".json", *((".log",) if log else ())):
        path.with_suffix(suffix).unlink(missing_ok=True)
