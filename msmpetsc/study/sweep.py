"""The cases of a study: each sweep's lists multiplied with each other, for each of its scenes; then those of maps."""

import math
from collections.abc import Collection, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

from msmpetsc.errors import InputError
from msmpetsc.scene.reading import load_scene
from msmpetsc.scene.schema import Scene
from msmpetsc.study.case import Case
from msmpetsc.study.maps import map_cases
from msmpetsc.study.overrides import content, inline, solver_changes, time_changes
from msmpetsc.study.schema import Reference, Study, StudyScene, Sweep


def cases(study: Study, folder: Path, full: bool, presets: Collection[str] | None = None) -> list[Case]:
    """All cases, each once, in the order of the file; ``folder`` is that of the study file.

    Raises InputError for a scene file or a change of it that is wrong.
    """
    found: dict[str, Case] = {}
    for sweep in study.sweep:
        for scene in study.scene:
            wanted = (not sweep.scenes or scene.name in sweep.scenes) and (full or not (sweep.full or scene.full))
            for case in _cases(study, scene, sweep, folder, presets) if wanted else ():
                found.setdefault(case.id, case)
    for one in study.map:
        for case in map_cases(study, one, folder, presets) if full or not one.full else ():
            found.setdefault(case.id, case)
    return list(found.values())


def _cases(
    study: Study, scene: StudyScene, sweep: Sweep, folder: Path, presets: Collection[str] | None
) -> Iterator[Case]:
    file = folder / scene.file
    changes = (*scene.set, *sweep.set)
    as_given = load_scene(file, changes, presets, by_user=False)
    for cells, integrator in product(sweep.cells or (None,), sweep.integrators):
        sized = (*changes, *((f"cages.count={cells}",) if cells else ()))
        base = Case(
            scene.name, file, content(file, as_given), sized, integrator, "", "", cells, as_given.time.step, None, None, None,
            repeats=study.repeats, timeout=study.timeout,
        )  # fmt: skip
        reference = _reference(base, scene, scene.reference, as_given) if scene.reference else None
        for case in _methods(replace(base, reference=reference), scene, sweep, as_given):
            load_scene(file, case.set, presets, by_user=False)  # what is wrong is said before anything is run
            yield case


def _methods(base: Case, scene: StudyScene, sweep: Sweep, as_given: Scene) -> Iterator[Case]:
    """The cases of one lattice and integrator."""
    steps, ranks = sweep.time_steps or (as_given.time.step,), sweep.ranks
    if base.integrator == "verlet":
        for step, substep, n in product(steps, sweep.substeps or (None,), ranks):
            case = replace(base, time_step=step, substep=substep, ranks=n, label=_label(sweep, "verlet", "", n))
            yield _timed(case, scene, sweep, as_given)
        return
    goals = [(error, None) for error in sweep.errors] + [(None, budget) for budget in sweep.max_iterations]
    goals = goals or [(as_given.solver.error, as_given.solver.max_iterations)]
    for preset, options, step, goal, n in product(
        sweep.presets or (as_given.solver.preset,), sweep.options, steps, goals, ranks
    ):
        case = replace(
            base, preset=preset, options=options, time_step=step, error=goal[0], max_iterations=goal[1], ranks=n,
            label=_label(sweep, _called(base.integrator, preset), options, n), true_error=scene.true_error,
            trace=scene.trace if sweep.trace else None,
        )  # fmt: skip
        yield _timed(replace(case, set=(*case.set, *solver_changes(case, as_given))), scene, sweep, as_given)


def _called(integrator: str, preset: str) -> str:
    return preset if integrator == "implicit-euler" else f"{integrator} {preset}"


def _label(sweep: Sweep, method: str, options: str, ranks: int) -> str:
    """What its curve is called."""
    name = sweep.label or f"{method} {options}".strip()
    return name if ranks == 1 or sweep.ranks == (ranks,) else f"{name}, {ranks} ranks"


def _timed(case: Case, scene: StudyScene, sweep: Sweep, as_given: Scene) -> Case:
    """With its time table, its output at the moments that are compared, and nothing measured beyond its end."""
    steps = sweep.steps or (scene.steps if scene.duration is None else None)
    duration = steps * case.time_step if steps else scene.duration or as_given.time.duration
    steps = max(1, round(duration / case.time_step))
    if case.trace and case.trace > steps:
        raise InputError(f"scene {case.scene}: trace = {case.trace}, but {case.label} takes {steps} steps")
    case = replace(case, true_error=case.true_error and min(case.true_error, steps))
    every = 1
    if case.reference is not None:
        every = max(1, round((scene.frame or as_given.time.step) / case.time_step))
    return replace(case, set=(*case.set, *time_changes(case, duration, every, as_given)))


def _reference(base: Case, scene: StudyScene, reference: Reference, as_given: Scene) -> Case:
    """The run that this lattice's motion is measured against, stored at the moments that are compared."""
    frame = scene.frame or as_given.time.step
    duration = scene.duration or (scene.steps * as_given.time.step if scene.steps else as_given.time.duration)
    return reference_case(base, reference, frame, duration, as_given)


def reference_case(base: Case, reference: Reference, frame: float, duration: float, scene: Scene) -> Case:
    """A run of the same lattice with tiny steps; frame, duration [s]."""
    verlet = reference.integrator == "verlet"
    step, every = (frame, 1) if verlet else (reference.step, round(frame / reference.step))
    if not verlet and (every < 1 or not math.isclose(every * step, frame, rel_tol=1e-6)):
        raise InputError(f"scene {base.scene}: frame = {frame:g} s is no multiple of reference.step = {step:g} s")
    case = replace(
        base, integrator=reference.integrator, time_step=step, substep=reference.substep if verlet else None,
        repeats=1, timeout=reference.timeout, label="reference", ranks=1, true_error=None, trace=None, reference=None,
    )  # fmt: skip
    solver = ()
    if not verlet:
        case = replace(case, preset=reference.preset, error=reference.error)
        solver = (f"solver={inline({'preset': reference.preset, 'error': reference.error})}",)
    return replace(case, set=(*case.set, *solver, *time_changes(case, duration, every, scene)))
