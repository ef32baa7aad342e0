"""Linear systems of a study's problems, for other solvers: one run for each problem."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from msmpetsc.app.request import steps_in
from msmpetsc.comm import log
from msmpetsc.errors import InputError
from msmpetsc.study.cases import Case, command, study_cases
from msmpetsc.study.process import Processes
from msmpetsc.study.study_file import load_study

# files of a run that go after it; the systems and the log stay
REMOVED = (".h5", ".xdmf", ".json")


def export_systems(path: Path, folder: Path, steps: str, full: bool = False) -> list[Path]:
    """Write the first linear systems of steps of each problem of a study; return their folders.

    steps : numbers like "1,5,20"; "" for the first step
    full  : include sweeps and scenes that are marked ``full``

    Problems whose run fails are left out with a warning. Raises InputError if all fail.
    """
    last, processes, written = max(steps_in(steps)), Processes(), []
    named = problems(study_cases(load_study(path), path.parent, full))
    if not named:
        raise InputError(f"{path}: no sweep solves linear systems, so --export has none to write")
    try:
        for name, case in named.items():
            own = folder / name
            own.mkdir(parents=True, exist_ok=True)
            result = own / "run.h5"
            words = [*command(case, result, own / "run.json"), "--frames", str(last)]
            words += ["--export", str(own), *(["--export-steps", steps] if steps else [])]
            ended = processes.run(words, own / "run.log", case.timeout)
            for suffix in REMOVED:
                result.with_suffix(suffix).unlink(missing_ok=True)
            if ended.reason:
                log.warning("%s: %s; see %s", name, ended.reason, own / "run.log")
            else:
                written.append(own)
    finally:
        processes.close()
    if not written:
        raise InputError(f"{path}: no run wrote its systems; {folder} has their logs")
    return written


def problems(cases: Sequence[Case]) -> dict[str, Case]:
    """Return a case of Newton's method for each problem of the sweeps, by the problem's name.

    Cases of the same scene, lattice, law, integrator and time step have the same problem, whatever
    their solvers are.
    """
    firsts: dict[tuple[object, ...], Case] = {}
    for case in cases:
        if case.point is None and case.integrator != "verlet":
            kept = tuple(change for change in case.set if not change.startswith("solver="))
            case = replace(case, set=(*kept, 'solver.preset="newton"'), options="", true_error=None)
            firsts.setdefault((case.file, case.set, case.integrator), case)
    named: dict[str, Case] = {}
    for case in firsts.values():
        base = re.sub(r"[^A-Za-z0-9.-]+", "_", case.scene)
        number = sum(name == base or name.startswith(f"{base}-") for name in named)
        named[f"{base}-{number + 1}" if number else base] = case
    return named
