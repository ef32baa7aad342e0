"""Cases of a study: the settings of each run, expanded from the sweeps and maps of its file."""

import hashlib
import json
import math
import os
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from msmpetsc import __version__
from msmpetsc.errors import InputError
from msmpetsc.scene.reading import Scene, load_scene
from msmpetsc.scene.toml import toml_value
from msmpetsc.study.process import PROGRAM
from msmpetsc.study.study_file import Axis, Length, Map, MapCase, Study, StudyScene, Sweep

# table and key of the scene file that hold a field of Case
OVERRIDES = {
    "integrator": ("time", "integrator"),
    "preset": ("solver", "preset"),
    "time_step": ("time", "step"),
    "substep": ("time", "substep"),
    "error": ("solver", "error"),
    "max_iterations": ("solver", "max_iterations"),
}
# fields of Case that are columns of table.csv
CASE_COLUMNS = ("scene", "options", "label", "ranks", "repeats", "cells", *OVERRIDES)
# override of a case whose surface is compared with its reference
SURFACE = "output.surface=true"
# fields of Case without effect on the result, or that enter ``id`` in another form
OUTSIDE_ID = ("file", "label", "timeout", "reference")


@dataclass(frozen=True)
class MapPoint:
    """A point (x, y) of a stability map; ``recovers`` asks for the rest shape at the end."""

    map: str
    x: str | float
    y: str | float
    recovers: bool = False


@dataclass(frozen=True, kw_only=True)
class Case:
    """The settings of a run and its repeats; None leaves a choice to the scene or the program.

    content    : digest of the scene file and of the files that it names
    set        : all overrides of the scene, "key.path=value"; some fields below repeat an override,
                 for a column of the table
    preset     : "" for verlet
    substep    : upper limit of verlet's substeps [s]
    true_error : number of steps between measurements of the true step error
    reference  : run whose motion counts as exact; None without a reference
    point      : point of a map; None for a case of a sweep
    """

    scene: str
    file: Path
    content: str
    set: tuple[str, ...]
    integrator: str
    time_step: float
    preset: str = ""
    options: str = ""
    cells: int | None = None
    substep: float | None = None
    error: float | None = None
    max_iterations: int | None = None
    ranks: int = 1
    repeats: int = 1
    true_error: int | None = None
    label: str = ""
    timeout: float = 300.0
    reference: "Case | None" = None
    point: MapPoint | None = None

    @property
    def id(self) -> str:
        """Digest of the settings that affect the result, and of the program's version."""
        settings = {name: value for name, value in asdict(self).items() if name not in OUTSIDE_ID}
        settings |= {"version": __version__, "reference": self.reference and self.reference.id}
        return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def stores_surface(self) -> bool:
        """Whether the surface, not the nodes, is compared with the reference."""
        return SURFACE in self.set

    @property
    def columns(self) -> dict[str, Any]:
        """Columns of the table that are known before the run."""
        row = {name: getattr(self, name) for name in CASE_COLUMNS}
        if self.point:
            row |= {"map": self.point.map, "x": str(self.point.x), "y": str(self.point.y)}
        return row | {"case": self.id}

    def changed(self, *changes: str) -> "Case":
        """Return a copy of the case with further overrides of its scene."""
        return replace(self, set=(*self.set, *changes))


def run_arguments(case: Case, *output: str) -> list[str]:
    """Return the command line arguments of ``msmpetsc`` for a case.

    PETSc's options come last, because a flag without a value would take the next word as its value.
    """
    changes = [word for change in case.set for word in ("--set", change)]
    if case.true_error is not None:
        changes += ["--true-error", str(case.true_error)]
    return ["run", os.path.relpath(case.file), *output, *changes, *shlex.split(case.options)]


def launcher(ranks: int) -> list[str]:
    """Return the words that start a program on this number of ranks."""
    return ["mpiexec", "-n", str(ranks)] if ranks > 1 else []


def command(case: Case, result: Path, measure: Path) -> list[str]:
    """Return the command of a run that writes the files ``result`` and ``measure`` (its cost)."""
    output = ("-o", str(result), "--overwrite", "--measure", str(measure))
    return [*launcher(case.ranks), *PROGRAM, *run_arguments(case, *output)]


def shown_command(case: Case) -> str:
    """Return the shell command that repeats the case."""
    return shlex.join([*launcher(case.ranks), "msmpetsc", *run_arguments(case)])


def digest(file: Path, scene: Scene) -> str:
    """Return the digest of a scene file and of the files that it names."""
    names = sorted({name for _, name in scene.named_files()})
    paths = [file, *(file.parent / name for name in names)]
    contents = b"\0".join(path.read_bytes() for path in paths if path.is_file())
    return hashlib.sha256(contents).hexdigest()[:16]


def with_tables(
    case: Case, duration: float, every: int, scene: Scene, surface: bool = False
) -> Case:
    """Return a case with overrides of the tables time, output and, except for verlet, solver.

    duration : [s]
    every    : steps between stored frames
    surface  : whether to store the surface
    """
    tables: dict[str, dict[str, Any]] = {
        "time": scene.time.model_dump(exclude_unset=True) | {"duration": duration},
        "solver": {},
    }
    for name, (table, key) in OVERRIDES.items():
        tables[table][key] = getattr(case, name)
    if case.integrator == "verlet":
        del tables["solver"]
    case = case.changed(
        *(f"{name}={toml_value(table)}" for name, table in tables.items()),
        SURFACE if surface else "output.surface=false",
    )
    return case.changed(f"output.every={every}") if every > 1 else case


def study_cases(study: Study, folder: Path, full: bool) -> list[Case]:
    """Return the distinct cases of a study in the order of its file.

    full : include sweeps, scenes and maps that are marked ``full``

    Raises InputError if a scene with its overrides is not valid.
    """
    by_id: dict[str, Case] = {}
    for sweep in study.sweep:
        for scene in study.scene:
            if (sweep.scenes and scene.name not in sweep.scenes) or (
                not full and (sweep.full or scene.full)
            ):
                continue
            for own in with_laws(scene, sweep):
                for case in sweep_cases(study, *own, folder):
                    by_id.setdefault(case.id, case)
    for map in study.map:
        for case in map_cases(study, map, folder) if full or not map.full else ():
            by_id.setdefault(case.id, case)
    return list(by_id.values())


def with_laws(scene: StudyScene, sweep: Sweep) -> Iterator[tuple[StudyScene, Sweep]]:
    """Yield the scene and a sweep of a single law for each material law of the sweep."""
    if not sweep.laws:
        yield scene, sweep
    for law in sweep.laws:
        changed = scene.model_copy(update={"set": (*scene.set, f"material.law={law}")})
        yield changed, sweep.model_copy(update={"laws": (law,)})


def sweep_cases(study: Study, scene: StudyScene, sweep: Sweep, folder: Path) -> Iterator[Case]:
    """Yield the cases of a sweep over a scene. Raises InputError if the scene is not valid."""
    file = folder / scene.file
    changes = (*scene.set, *sweep.set)
    as_given = load_scene(file, changes, by_user=False)
    integrators = sweep.integrators or (as_given.time.integrator,)
    for cells, integrator in product(sweep.cells or (None,), integrators):
        base = Case(
            scene=scene.name, file=file, content=digest(file, as_given), integrator=integrator,
            set=(*changes, *((f"cages.count={cells}",) if cells else ())), cells=cells,
            time_step=as_given.time.step, repeats=study.repeats, timeout=study.timeout,
        )  # fmt: skip
        base = replace(base, reference=_reference(base, scene, as_given))
        for case in _methods(base, scene, sweep, as_given):
            # an invalid scene must be refused before the first run
            load_scene(file, case.set, by_user=False)
            yield case


def _methods(base: Case, scene: StudyScene, sweep: Sweep, as_given: Scene) -> Iterator[Case]:
    """Yield a case for each method of a sweep, with the lattice and the integrator of ``base``."""
    steps = sweep.time_steps or (as_given.time.step,)
    if base.integrator == "verlet":
        lists: dict[str, Sequence[Any]] = {"time_step": steps, "substep": sweep.substeps or (None,)}
    else:
        base = replace(base, true_error=scene.true_error)
        goals: list[dict[str, Any]] = [{"error": error} for error in sweep.errors]
        goals += [{"max_iterations": budget} for budget in sweep.max_iterations]
        goals = goals or [
            {"error": as_given.solver.error, "max_iterations": as_given.solver.max_iterations}
        ]
        presets = sweep.presets or (as_given.solver.preset,)
        lists = {"preset": presets, "options": sweep.options, "time_step": steps, "goal": goals}
    lists["ranks"] = sweep.ranks
    for choice in product(*lists.values()):
        values = dict(zip(lists, choice, strict=True))
        case = replace(base, **values.pop("goal", {}), **values)
        yield _timed(replace(case, label=_label(sweep, case)), scene, sweep, as_given)


def _label(sweep: Sweep, case: Case) -> str:
    integrator = case.integrator.removeprefix("implicit-euler")
    name = sweep.label or " ".join(filter(None, (integrator, case.preset, case.options)))
    if sweep.laws:
        has_methods = max(map(len, (sweep.integrators, sweep.presets, sweep.options))) > 1
        # the law alone names the curve if all cases have the same method
        name = ", ".join([*([name] if sweep.label or has_methods else []), *sweep.laws])
    if case.ranks == 1 or len(sweep.ranks) == 1:
        return name
    return f"{name}, {case.ranks} ranks"


def _timed(case: Case, scene: StudyScene, sweep: Sweep, as_given: Scene) -> Case:
    """Return a case with its duration, and with frames at the times of the reference's frames.

    ``true_error`` is at most the number of steps, so that a run measures at least one step.
    """
    length = Length(steps=sweep.steps) if sweep.steps else scene
    duration = length.seconds(case.time_step, as_given.time.duration)
    steps = max(1, round(duration / case.time_step))
    case = replace(case, true_error=case.true_error and min(case.true_error, steps))
    every = 1
    if case.reference is not None:
        every = max(1, round(as_given.time.step / case.time_step))
    surface = case.reference is not None and case.reference.stores_surface
    return with_tables(case, duration, every, as_given, surface)


def _reference(base: Case, scene: StudyScene, as_given: Scene) -> Case | None:
    """Return the reference run of a case, or None if the scene has no reference.

    The reference has short steps, and frames at the times that are compared. It runs on the case's
    lattice, unless it has its own ``cells``. In that case only the scene's overrides and the law
    apply to it, and surfaces are compared.
    """
    reference = scene.reference
    if reference is None:
        return None
    if reference.cells:
        base = replace(
            base, cells=reference.cells, set=(*scene.set, f"cages.count={reference.cells}")
        )
    if reference.law:
        base = base.changed(f"material.law={reference.law}")
    frame = as_given.time.step
    duration = scene.seconds(frame, as_given.time.duration)
    if reference.integrator == "verlet":
        step = frame
        own: dict[str, Any] = {"substep": reference.substep}
    else:
        # the schema has refused an implicit reference without a step
        step = reference.step or frame
        own = {"preset": reference.preset, "error": reference.error}
    every = round(frame / step)
    if every < 1 or not math.isclose(every * step, frame, rel_tol=1e-6):
        raise InputError(
            f"scene {base.scene}: time.step = {frame:g} s "
            f"is no multiple of reference.step = {step:g} s"
        )
    case = replace(
        base, integrator=reference.integrator, time_step=step, repeats=1, label="reference",
        timeout=reference.timeout, **own,
    )  # fmt: skip
    return with_tables(case, duration, every, as_given, reference.cells is not None)


def map_cases(study: Study, map: Map, folder: Path) -> Iterator[Case]:
    """Yield the cases of a map: each method at each point. Raises InputError."""
    for x, y, run in map_points(map):
        file = folder / run.file
        scene = load_scene(file, run.set, by_user=False)
        step = scene.time.step
        duration = run.seconds(step, scene.time.duration)
        for method in study.method:
            if map.methods and method.label not in map.methods:
                continue
            options = method.options
            preset = ""
            if method.integrator != "verlet":
                options = f"{options} {run.options}".strip()
                preset = method.preset
            case = Case(
                scene=map.name, file=file, content=digest(file, scene), set=(*run.set, *method.set),
                integrator=method.integrator, time_step=step, preset=preset, options=options,
                error=method.error, max_iterations=method.max_iterations, label=method.label,
                point=MapPoint(map.name, method.label if x is None else x, y, run.recovers),
                timeout=study.timeout,
            )  # fmt: skip
            yield with_tables(case, max(duration, step), 1, scene)


def map_points(map: Map) -> Iterator[tuple[float | None, float | str, MapCase]]:
    """Yield x, y and the run of each point of a map.

    For a named case, x is None and y is the name.
    """
    for case in map.case:
        length = case if case.steps or case.duration else map
        own = {"set": (*map.set, *case.set), "steps": length.steps, "duration": length.duration}
        yield None, case.name, case.model_copy(update=own)
    if map.x and map.y and map.file:
        for y, x in product(map.y.values, map.x.values):
            changes = (*map.set, *axis_changes(map.x, x, map), *axis_changes(map.y, y, map))
            case = MapCase(
                name=map.name, file=map.file, steps=map.steps, duration=map.duration, set=changes
            )
            yield x, y, case


def axis_changes(axis: Axis, value: float, length: Length) -> Iterator[str]:
    """Yield the overrides for a value of an axis; an axis of time steps also sets the duration."""
    yield from axis.changes(value)
    if axis.key == "time.step":
        yield f"time.duration={max(length.seconds(value, value), value)!r}"
