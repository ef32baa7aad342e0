"""Run the cases of a study, compare them with their references, and keep the table up to date."""

import os
import shutil
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from tqdm import tqdm

from msmpetsc.errors import InputError, printable
from msmpetsc.results.disk import Lock as FileLock
from msmpetsc.results.disk import write_whole
from msmpetsc.study.cases import Case, command, shown_command, study_cases
from msmpetsc.study.metrics import (
    costs,
    frame_metrics,
    merge_repeats,
    read_record,
    surface_error,
    trajectory_error,
)
from msmpetsc.study.outcomes import outcome
from msmpetsc.study.process import Ended, Processes, too_long
from msmpetsc.study.study_file import Study, load_study
from msmpetsc.study.table import Row, read_table, records, require_extra, write_table

# folder of the parts' folders
PARTS = "parts"
# first words of a reason
NO_REFERENCE = "no reference: "


@dataclass
class Bench:
    """Runner of cases in a folder that keeps the result files of references.

    study  : name of the study, a column of the table
    _locks : a lock for each reference, by its id
    """

    folder: Path
    processes: Processes
    study: str = ""
    _locks: dict[str, Lock] = field(default_factory=dict)

    def result_of(self, case: Case) -> Path:
        """Return the path of a case's result file."""
        return self.folder / "runs" / f"{case.id}.h5"

    def measure(self, case: Case, keep: bool = False) -> Row:
        """Run a case with its repeats; return its row of the table, with the reason of a failure.

        keep : keep the result file, unless the run fails
        """
        runs: list[Row] = []
        path = self.result_of(case)
        known = case.columns | {"study": self.study, "command": shown_command(case)}
        reference, why = self._reference(case)
        for repeat in range(case.repeats):
            if repeat == 1:
                case = replace(case, true_error=None)
            ended = self._run(case, path)
            record = read_record(path.with_suffix(".json"))
            row, problem = _figures(case, path, record)
            if repeat == 0 and reference is not None and not ended.reason:
                errors, why = _distance(case, path, reference)
                row |= errors
            if not keep or ended.reason:
                _remove_files(path, log=not ended.reason)
            runs.append(row)
            if ended.reason:
                break
            why = why or problem
        row = known | merge_repeats(runs) | {"status": ended.word, "reason": ended.reason or why}
        if case.point:
            kind = (record.get("failure") or {}).get("kind", "")
            row["outcome"] = outcome(ended.status, kind, row, case.point.recovers)
        if time := row.get("time_frame"):
            row |= {"fps": 1 / time, "time_second": time / case.time_step}
        return row

    def _run(self, case: Case, path: Path) -> Ended:
        path.parent.mkdir(parents=True, exist_ok=True)
        words = command(case, path, path.with_suffix(".json"))
        return self.processes.run(words, path.with_suffix(".log"), case.timeout)

    def _reference(self, case: Case) -> tuple[Path | None, str]:
        """Return the result of a case's reference, run on first use; or None and the reason."""
        if case.reference is None:
            return None, ""
        path = self.folder / "references" / f"{case.reference.id}.h5"
        with self._locks.setdefault(case.reference.id, Lock()):
            failed = path.with_suffix(".failed")
            reason = failed.read_text() if failed.is_file() else ""
            if not path.is_file() and not reason:
                part = path.with_suffix(".part.h5")
                ended = self._run(case.reference, part)
                if self.processes.stopped:
                    return None, "stopped"
                reason = ended.reason
                if not reason:
                    os.replace(part, path)
                elif not _is_unwritten(case.reference, reason):
                    write_whole(failed, reason)
                _remove_files(part, log=not reason)
        return (path, "") if path.is_file() else (None, f"{NO_REFERENCE}{reason}")


def _figures(case: Case, path: Path, record: dict[str, Any]) -> tuple[Row, str]:
    """Return the metrics of a run, and the reason if any are missing."""
    row = costs(record)
    try:
        row |= frame_metrics(path, case.time_step)
    except (OSError, ValueError, InputError) as error:
        return row, f"no figures: {error}"
    if case.integrator == "verlet":
        # verlet solves no system, so there is no error to estimate
        row["estimated_error"] = None
    return row, ""


def _distance(case: Case, path: Path, reference: Path) -> tuple[Row, str]:
    """Return the error of a run against its reference as a column, or {} and the reason."""
    name, measure = (
        ("surface", surface_error) if case.stores_surface else ("trajectory", trajectory_error)
    )
    try:
        return {f"{name}_error": measure(path, reference)}, ""
    except InputError as error:
        return {}, f"no {name} error: {error}"


def _remove_files(path: Path, log: bool) -> None:
    """Remove the files of a run, including its log if ``log`` is True."""
    for suffix in (".h5", ".xdmf", ".json", *((".log",) if log else ())):
        path.with_suffix(suffix).unlink(missing_ok=True)


def run_study(
    path: Path,
    folder: Path,
    *,
    full: bool = False,
    jobs: int | None = None,
    restart: bool = False,
    part: tuple[int, int] | None = None,
) -> list[Row]:
    """Run the cases of a study file that are not done, and return the rows of all cases.

    full    : include sweeps, scenes and maps that are marked ``full``
    jobs    : number of cases at a time; the study file's if None
    restart : discard the rows and references of earlier runs
    part    : (i, n): run and return only part i of n, counted from 1, in its own folder

    ``folder`` gets table.csv, study.toml and references/. Rows of earlier runs and of parts are
    kept if their cases are still in the file.

    Raises InputError before the first run, also if another process runs a study in this folder, or
    if cases of another study would be dropped.
    """
    require_extra()
    study = load_study(path)
    every, wanted = _cases(study, path, full)
    own = folder
    if part:
        wanted = np.array_split(wanted, part[1])[part[0] - 1].tolist()
        own = part_folder(folder, part)
    own.mkdir(parents=True, exist_ok=True)
    with closing(FileLock(own / "table.csv")):
        if restart:
            _clear(own)
        else:
            _refuse_other_study(own, path.stem, every)
        known = [own] if restart else [own, folder, *sorted((folder / PARTS).glob("*"))]
        kept = {case: every[case] for case in wanted} if part else every
        rows = _continued(known, kept)

        def add(*measured: Row) -> None:
            rows.update({row["case"]: row for row in measured})
            write_table(own, [rows[case] for case in kept if case in rows])

        write_whole(own / "study.toml", path.read_bytes())
        add()
        todo = [every[case] for case in wanted if not _is_done(every[case], rows)]
        bench = Bench(own, Processes(), path.stem)
        _carry_out(bench, todo, add, jobs=jobs or study.jobs, done=len(wanted) - len(todo))
        return [rows[case] for case in wanted]


def list_study(path: Path, folder: Path, full: bool = False) -> list[tuple[Case, bool]]:
    """Return each case of a study file and whether it is done, without running any."""
    require_extra()
    every, wanted = _cases(load_study(path), path, full)
    rows = _continued([folder, *sorted((folder / PARTS).glob("*"))], every)
    return [(every[case], _is_done(every[case], rows)) for case in wanted]


def part_folder(study: Path, part: tuple[int, int]) -> Path:
    """Return the folder of a part's table and results."""
    return study / PARTS / "{}-of-{}".format(*part)


def _cases(study: Study, path: Path, full: bool) -> tuple[dict[str, Case], list[str]]:
    """Return all cases by their id, and the ids of the cases to run."""
    every = {case.id: case for case in study_cases(study, path.parent, True)}
    return every, [case.id for case in study_cases(study, path.parent, full)]


def _carry_out(
    bench: Bench, todo: Sequence[Case], add: Callable[[Row], None], *, jobs: int, done: int
) -> None:
    """Run cases and add their rows, with a progress bar that starts at ``done``."""
    bar = tqdm(total=done + len(todo), initial=done, unit="case", dynamic_ncols=True, disable=None)
    pool = ThreadPoolExecutor(jobs)
    try:
        with bar:
            futures = [pool.submit(bench.measure, case) for case in todo]
            for count, future in enumerate(as_completed(futures), done + 1):
                row = future.result()
                add(row)
                bar.write(f"case {count}/{bar.total}  {described(row)}", file=sys.stderr)
                bar.update()
    finally:
        # after an exception or an interrupt, runs may still be in progress
        bench.processes.close()
        pool.shutdown(cancel_futures=True)
        # the folder is not empty if a failed case has left its log
        with suppress(OSError):
            (bench.folder / "runs").rmdir()


def described(row: Row) -> str:
    """Return a line of progress: a case's name and its outcome."""
    if row.get("map"):
        return f"{row['map']} {row['label']} at {row['x']}, {row['y']}: {row['outcome']}"
    return f"{row['scene']} {row['label']}: {row['status']} {row['reason']}".rstrip()


# ---- results of earlier runs


def _clear(folder: Path) -> None:
    """Remove the table, the logs and the references of earlier runs from a folder."""
    (folder / "table.csv").unlink(missing_ok=True)
    for name in ("runs", "references", PARTS):
        shutil.rmtree(folder / name, ignore_errors=True)


def _continued(folders: Sequence[Path], by_id: dict[str, Case]) -> dict[str, Row]:
    """Return the rows of these cases from earlier runs, with the labels of the study file.

    If several folders have a row of a case, the first row of a finished case counts.
    """
    known: dict[str, Row] = {}
    for folder in dict.fromkeys(folders):
        rows = {row["case"]: row for row in _earlier_rows(folder) if row["case"] in by_id}
        new = {case: row for case, row in rows.items() if not _is_done(by_id[case], known)}
        known |= {case: row | {"label": by_id[case].label} for case, row in new.items()}
    return known


def _refuse_other_study(folder: Path, study: str, cases: dict[str, Case]) -> None:
    """Raise InputError if the folder's table has cases of another study that would be dropped."""
    rows = [row for row in _earlier_rows(folder) if row["case"] not in cases]
    if others := {row["study"] for row in rows} - {study}:
        raise InputError(
            f"{folder / 'table.csv'} has cases of the study {printable(min(others), 60)}: "
            "name another folder by -o, or --restart replaces them"
        )


def _earlier_rows(folder: Path) -> list[Row]:
    path = folder / "table.csv"
    if not path.is_file():
        return []
    table = read_table(folder)
    if (table["case"] == "").any() or table[["ranks", "repeats"]].isna().any(axis=None):
        raise InputError(
            f"{path} is not the table of a study of this version: --restart begins anew"
        )
    return records(table)


def _is_done(case: Case, rows: dict[str, Row]) -> bool:
    """Return whether a case is done: it has a row, which tells of the case.

    A timeout under another time limit, and a file that could not be written, do not count.
    """
    row = rows.get(case.id)
    if row is None:
        return False
    reason = row["reason"]
    if row["status"] == "timeout":
        return bool(reason == too_long(case.timeout))
    if row["status"] == "failed" and _is_unwritten(case, reason):
        return False
    return case.reference is None or not (
        reason.startswith(NO_REFERENCE) and _is_unwritten(case.reference, reason)
    )


def _is_unwritten(case: Case, reason: str) -> bool:
    """Return whether a run failed because it cannot write its own files, which the reason names.

    The disk may be full, or a run that outlived a killed study may still write the file.
    """
    return f"{case.id}." in reason
