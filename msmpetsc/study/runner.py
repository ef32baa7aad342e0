"""A study is carried out: case after case, the table written after each, so that it can be stopped and continued."""

import json
import os
import shutil
from collections.abc import Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path

from msmpetsc.errors import InputError
from msmpetsc.study.case import Case
from msmpetsc.study.measure import Bench, Measured
from msmpetsc.study.metrics import Row
from msmpetsc.study.process import Processes, too_long
from msmpetsc.study.progress import StudyProgress
from msmpetsc.study.reading import load_study
from msmpetsc.study.schema import Study
from msmpetsc.study.sweep import cases
from msmpetsc.study.table import read_table, write_table

PARTS = "parts"  # folder of the parts' folders


@dataclass
class Findings:
    """What is known so far, in its folder: rows and traces by case, in the order of ``order``."""

    folder: Path
    order: Sequence[str]
    rows: dict[str, Row] = field(default_factory=dict)
    traces: dict[str, dict] = field(default_factory=dict)

    def add(self, found: Measured) -> None:
        case = found.row["case"]
        self.rows[case] = found.row
        if found.trace:
            self.traces[case] = {key: found.row[key] for key in ("case", "scene", "label")} | {"trace": found.trace}
        self.write()

    def write(self) -> None:
        """Table and traces, each replaced whole."""
        write_table(self.folder, [self.rows[case] for case in self.order if case in self.rows])
        part = self.folder / "traces.json.part"
        part.write_text(json.dumps([self.traces[case] for case in self.order if case in self.traces]))
        os.replace(part, self.folder / "traces.json")


@dataclass(frozen=True)
class Part:
    """The ``index``-th of ``count`` parts of a study, from 1: cases that follow each other, for they share references.

    Its table stands in a folder of its own, so that parts may run at the same time, on any machines.
    """

    index: int
    count: int

    def of(self, cases: Sequence[str]) -> Sequence[str]:
        return cases[len(cases) * (self.index - 1) // self.count : len(cases) * self.index // self.count]

    def folder(self, study: Path) -> Path:
        return study / PARTS / f"{self.index}-of-{self.count}"


def run_study(
    path: Path,
    folder: Path,
    presets: Collection[str],
    full: bool = False,
    jobs: int | None = None,
    restart: bool = False,
    part: Part | None = None,
) -> list[Row]:
    """Run what is not done yet of a study file, as many cases at a time as ``jobs`` or else the file says; all rows.

    The folder gets table.csv, table.h5, traces.json, study.toml, references/. Cases that are done and still in the
    file are kept, those of its parts too; ``restart`` forgets them. With a ``part`` only that is run, in a folder of
    its own, and only its rows are returned. Raises InputError before anything is run.
    """
    study = load_study(path, presets)
    every, wanted = _cases(study, path, full, presets)
    wanted = part.of(wanted) if part else wanted
    own = part.folder(folder) if part else folder
    own.mkdir(parents=True, exist_ok=True)
    if restart:
        _forget(own)
    known = [own] if restart else [own, folder, *sorted((folder / PARTS).glob("*"))]
    findings = _continued(known, {case: every[case] for case in wanted} if part else every)
    (own / "study.toml").write_bytes(path.read_bytes())
    findings.write()
    todo = [every[case] for case in wanted if not _is_done(every[case], findings.rows)]
    _carry_out(Bench(own, Processes(), path.stem), todo, findings, jobs or study.jobs, len(wanted) - len(todo))
    return [findings.rows[case] for case in wanted]


def list_study(path: Path, folder: Path, presets: Collection[str], full: bool = False) -> list[tuple[Case, bool]]:
    """The cases of a study file in their order, and whether each is done; nothing is run or written."""
    every, wanted = _cases(load_study(path, presets), path, full, presets)
    rows = _continued([folder, *sorted((folder / PARTS).glob("*"))], every).rows
    return [(every[case], _is_done(every[case], rows)) for case in wanted]


def _cases(study: Study, path: Path, full: bool, presets: Collection[str]) -> tuple[dict[str, Case], list[str]]:
    """All cases by their id, and the ids of those that are wanted."""
    every = {case.id: case for case in cases(study, path.parent, True, presets)}
    return every, [case.id for case in cases(study, path.parent, full, presets)]


def _carry_out(bench: Bench, todo: Sequence[Case], findings: Findings, jobs: int, done: int) -> None:
    """Run cases and keep what is found; ``done`` were before."""
    work = {case.id: case.work for case in todo}
    progress = StudyProgress(list(work.values()), done)
    try:
        with closing(measure_all(bench, todo, jobs)) as all_found:
            for found in all_found:
                findings.add(found)
                progress.update(found.row, work[found.row["case"]])
    finally:
        progress.close()
        with suppress(OSError):  # logs of cases that failed are in it
            (bench.folder / "runs").rmdir()


def measure_all(bench: Bench, todo: Sequence[Case], jobs: int = 1) -> Iterable[Measured]:
    """Each case's figures when it is done; whatever ends this early ends the runs under way."""
    pool = ThreadPoolExecutor(jobs)
    try:
        futures = [pool.submit(bench.measure, case) for case in todo]
        for future in as_completed(futures):
            yield future.result()
    finally:
        bench.processes.stop()
        pool.shutdown(cancel_futures=True)


def _continued(folders: Sequence[Path], by_id: dict[str, Case]) -> Findings:
    """What earlier runs left of these cases, called by their present names; the first of the folders is continued.

    Of a case in several of them the first row counts that need not be run again.
    """
    findings = Findings(folders[0], list(by_id))
    for folder in dict.fromkeys(folders):
        found = {row["case"]: row for row in read_table(folder) if row["case"] in by_id}
        new = {case: row for case, row in found.items() if not _is_done(by_id[case], findings.rows)}
        findings.rows |= {case: row | {"label": by_id[case].label} for case, row in new.items()}
        findings.traces |= _traces(folder, new)
    for case, entry in findings.traces.items():
        entry["label"] = by_id[case].label
    return findings


def _traces(folder: Path, cases: Collection[str]) -> dict[str, dict]:
    """Of these cases, what traces.json of a folder has."""
    traces = folder / "traces.json"
    try:
        told = json.loads(traces.read_text()) if traces.is_file() else []
        return {entry["case"]: entry for entry in told if entry["case"] in cases}
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{traces} is not what a study left: --restart begins anew") from None


def _is_done(case: Case, rows: dict[str, Row]) -> bool:
    """A case that was given up is worth another try once it may take longer (or less long)."""
    row = rows.get(case.id)
    return row is not None and not (row["status"] == "timeout" and row["reason"] != too_long(case.timeout))


def _forget(folder: Path) -> None:
    for name in ("table.csv", "table.h5", "traces.json"):
        (folder / name).unlink(missing_ok=True)
    for name in ("runs", "references", PARTS):
        shutil.rmtree(folder / name, ignore_errors=True)
