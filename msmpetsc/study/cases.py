"""The cases of a study: what defines a run, its command, and the products of sweeps and maps."""

import hashlib
import json
import math
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from msmpetsc import __version__
from msmpetsc.errors import InputError
from msmpetsc.scene.reading import Scene, load_scene
from msmpetsc.scene.toml import toml_value
from msmpetsc.study.forkserver import COLD
from msmpetsc.study.study_file import Axis, Length, Map, MapCase, Study, StudyScene, Sweep

OVERRIDES = {  # values of a case that stand in tables of its scene
    "integrator": ("time", "integrator"),
    "preset": ("solver", "preset"),
    "time_step": ("time", "step"),
    "substep": ("time", "substep"),
    "error": ("solver", "error"),
    "max_iterations": ("solver", "max_iterations"),
}
IN_TABLE = (
    "scene",
    "options",
    "label",
    "ranks",
    "repeats",
    "cells",
    *OVERRIDES,
)  # values that are columns
SURFACE = "output.surface=true"  # the override of a case whose surface is compared
NOT_ITS_IDENTITY = ("file", "label", "timeout", "reference")


@dataclass(frozen=True)
class MapPoint:
    """A point of a map, and whether its body should be in its rest shape at the end."""

    map: str
    x: str | float
    y: str | float
    recovers: bool = False


@dataclass(frozen=True, kw_only=True)
class Case:
    """A run and its repeats; the scene or the program decides what is None."""

    scene: str
    file: Path
    content: str  # digest of the scene file and of the files that it names
    set: tuple[str, ...]  # all overrides, "key.path=value"; what follows repeats them for the table
    integrator: str
    time_step: float  # [s]
    preset: str = ""  # as for verlet
    options: str = ""
    cells: int | None = None
    substep: float | None = None  # [s]
    error: float | None = None
    max_iterations: int | None = None
    ranks: int = 1
    repeats: int = 1
    true_error: int | None = None  # every so many steps the true step error is measured
    label: str = ""
    timeout: float = 300.0  # [s]
    reference: "Case | None" = None  # the run its motion is measured against
    point: MapPoint | None = None  # of a map; None for the case of a sweep

    @property
    def id(self) -> str:
        """Digest of what defines the run, without its label and its time limit."""
        what = {name: value for name, value in asdict(self).items() if name not in NOT_ITS_IDENTITY}
        what |= {"version": __version__, "reference": self.reference and self.reference.id}
        return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def stores_surface(self) -> bool:
        """Whether surfaces are compared with the reference, rather than nodes."""
        return SURFACE in self.set

    @property
    def columns(self) -> dict[str, Any]:
        """Columns of the table that are known before the case runs."""
        row = {name: getattr(self, name) for name in IN_TABLE}
        if self.point:
            row |= {"map": self.point.map, "x": str(self.point.x), "y": str(self.point.y)}
        return row | {"case": self.id}

    def changed(self, *changes: str) -> "Case":
        """Return the same run with further overrides of its scene."""
        return replace(self, set=(*self.set, *changes))


def run_arguments(case: Case) -> list[str]:
    """Return the arguments of ``msmpetsc`` for a case, without its outputs."""
    changes = [word for change in case.set for word in ("--set", change)]
    if case.true_error is not None:
        changes += ["--true-error", str(case.true_error)]
    return ["run", os.path.relpath(case.file), *changes, *shlex.split(case.options)]


def launcher(ranks: int) -> list[str]:
    """Return the words that start a program on so many ranks."""
    return ["mpiexec", "-n", str(ranks)] if ranks > 1 else []


def command(case: Case, result: Path, measure: Path) -> list[str]:
    """Return the command of one run: its frames go to ``result``, its figures to ``measure``."""
    name, scene, *rest = run_arguments(
        case
    )  # the last of which may be an option of PETSc's without a value
    outputs = ["-o", str(result), "--overwrite", "--measure", str(measure)]
    return [*launcher(case.ranks), *COLD, name, scene, *outputs, *rest]


def shown_command(case: Case) -> str:
    """Return the shell command that repeats the case."""
    return shlex.join([*launcher(case.ranks), "msmpetsc", *run_arguments(case)])


def digest(file: Path, scene: Scene) -> str:
    """Return the digest of a scene file and of the files that it names."""
    names = sorted({name for _, name in scene.named_files()})
    paths = [file, *(file.parent / name for name in names)]
    return hashlib.sha256(
        b"\0".join(path.read_bytes() for path in paths if path.is_file())
    ).hexdigest()[:16]


def scene_tables(values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the tables time and solver of a scene with a case's values; a key that is None is absent.

    Verlet solves nothing, so it has no solver table; implicit Euler is what a scene means that names no integrator.
    """
    values = {
        **values,
        "integrator": None if values["integrator"] == "implicit-euler" else values["integrator"],
    }
    names = ("time",) if values["integrator"] == "verlet" else ("time", "solver")
    tables: dict[str, dict[str, Any]] = {name: {} for name in names}
    for name, (table, key) in OVERRIDES.items():
        if table in tables and name in values:
            tables[table][key] = values[name]
    return tables


def with_tables(
    case: Case, duration: float, every: int, scene: Scene, surface: bool = False
) -> Case:
    """Return a case with the overrides of its solver, time and output tables."""
    tables = scene_tables(vars(case))
    time = (
        scene.time.model_dump(exclude_unset=True)
        | {"step": case.time_step, "duration": duration}
        | tables["time"]
    )
    solver = [f"solver={toml_value(tables['solver'])}"] if "solver" in tables else []
    case = case.changed(
        *solver, f"time={toml_value(time)}", SURFACE if surface else "output.surface=false"
    )
    return case.changed(f"output.every={every}") if every > 1 else case


def study_cases(study: Study, folder: Path, full: bool) -> list[Case]:
    """Return the distinct cases of a study in the order of its file. Raises InputError."""
    by_id: dict[str, Case] = {}
    for sweep in study.sweep:
        for scene in study.scene:
            if (sweep.scenes and scene.name not in sweep.scenes) or (
                not full and (sweep.full or scene.full)
            ):
                continue
            for own in of_laws(scene, sweep):
                for case in sweep_cases(study, *own, folder):
                    by_id.setdefault(case.id, case)
    for map in study.map:
        for case in map_cases(study, map, folder) if full or not map.full else ():
            by_id.setdefault(case.id, case)
    return list(by_id.values())


def combinations(lists: Mapping[str, Sequence[Any]]) -> Iterator[dict[str, Any]]:
    """Yield the Cartesian product of lists as dictionaries by their names; the last list changes fastest."""
    return (dict(zip(lists, values, strict=True)) for values in product(*lists.values()))


def of_laws(scene: StudyScene, sweep: Sweep) -> Iterator[tuple[StudyScene, Sweep]]:
    """Yield a scene and its reference with each material law of a sweep, and the sweep labelled by the law."""
    if not sweep.laws:
        yield scene, sweep
    for law in sweep.laws:
        changed = scene.model_copy(update={"set": (*scene.set, f"material.law={law}")})
        yield (
            changed,
            sweep.model_copy(update={"label": ", ".join(filter(None, (sweep.label, law)))}),
        )


def sweep_cases(study: Study, scene: StudyScene, sweep: Sweep, folder: Path) -> Iterator[Case]:
    """Yield the cases of a sweep over a scene, the product of its lists."""
    file = folder / scene.file
    changes = (*scene.set, *sweep.set)
    as_given = load_scene(file, changes, by_user=False)
    for cells, integrator in product(sweep.cells or (None,), sweep.integrators):
        base = Case(
            scene=scene.name, file=file, content=digest(file, as_given), integrator=integrator, cells=cells,
            set=(*changes, *((f"cages.count={cells}",) if cells else ())), time_step=as_given.time.step,
            repeats=study.repeats, timeout=study.timeout,
        )  # fmt: skip
        base = replace(base, reference=_reference(base, scene, as_given))
        for case in _methods(base, scene, sweep, as_given):
            load_scene(
                file, case.set, by_user=False
            )  # what is wrong is said before anything is run
            yield case


def _methods(base: Case, scene: StudyScene, sweep: Sweep, as_given: Scene) -> Iterator[Case]:
    """Yield the cases of one lattice and integrator."""
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
    for values in combinations(lists | {"ranks": sweep.ranks}):
        case = replace(base, **values.pop("goal", {}), **values)
        yield _timed(replace(case, label=_label(sweep, case)), scene, sweep, as_given)


def _label(sweep: Sweep, case: Case) -> str:
    integrator = case.integrator.removeprefix("implicit-euler")  # the usual one
    name = sweep.label or " ".join(filter(None, (integrator, case.preset, case.options)))
    return (
        name if case.ranks == 1 or sweep.ranks == (case.ranks,) else f"{name}, {case.ranks} ranks"
    )


def _timed(case: Case, scene: StudyScene, sweep: Sweep, as_given: Scene) -> Case:
    """Return a case with its time table, and output at the times that are compared.

    Nothing is measured beyond its end.
    """
    length = Length(steps=sweep.steps) if sweep.steps else scene
    duration = length.seconds(case.time_step, as_given.time.duration)
    steps = max(1, round(duration / case.time_step))
    case = replace(case, true_error=case.true_error and min(case.true_error, steps))
    every = 1
    if case.reference is not None:
        every = max(1, round((scene.frame or as_given.time.step) / case.time_step))
    surface = case.reference is not None and case.reference.stores_surface
    return with_tables(case, duration, every, as_given, surface)


def _reference(base: Case, scene: StudyScene, as_given: Scene) -> Case | None:
    """Return the reference run of a case, with tiny steps and output at times compared.

    It has the lattice of the case, unless it names cells of its own: then what a sweep changes is not changed in
    it, but for the law, if it names none.
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
    frame = scene.frame or as_given.time.step
    duration = scene.seconds(as_given.time.step, as_given.time.duration)
    case = replace(
        base,
        integrator=reference.integrator,
        time_step=frame,
        repeats=1,
        timeout=reference.timeout,
        label="reference",
    )
    surface = reference.cells is not None
    if reference.integrator == "verlet":
        return with_tables(replace(case, substep=reference.substep), duration, 1, as_given, surface)
    step = reference.step or frame  # the schema asks for it
    every = round(frame / step)
    if every < 1 or not math.isclose(every * step, frame, rel_tol=1e-6):
        raise InputError(
            f"scene {base.scene}: frame = {frame:g} s is no multiple of reference.step = {step:g} s"
        )
    case = replace(case, time_step=step, preset=reference.preset, error=reference.error)
    return with_tables(case, duration, every, as_given, surface)


def map_cases(study: Study, map: Map, folder: Path) -> Iterator[Case]:
    """Yield the cases of a map, each method at each of its points. Raises InputError."""
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
                error=method.error, max_iterations=method.max_iterations, label=method.label, timeout=study.timeout,
                point=MapPoint(map.name, method.label if x is None else x, y, run.recovers),
            )  # fmt: skip
            yield with_tables(case, max(duration, step), 1, scene)


def map_points(map: Map) -> Iterator[tuple[float | None, float | str, MapCase]]:
    """Yield the points x, y of a map and the run of each; of a named case x is None and y the name."""
    for case in map.case:
        length = case if case.steps or case.duration else map
        own = {"set": (*map.set, *case.set), "steps": length.steps, "duration": length.duration}
        yield None, case.name, case.model_copy(update=own)
    if map.x and map.y and map.file:
        for y, x in product(map.y.values, map.x.values):
            changes = (*map.set, *axis_changes(map.x, x, map), *axis_changes(map.y, y, map))
            yield (
                x,
                y,
                MapCase(
                    name=map.name,
                    file=map.file,
                    steps=map.steps,
                    duration=map.duration,
                    set=changes,
                ),
            )


def axis_changes(axis: Axis, value: float, length: Length) -> Iterator[str]:
    """Yield the overrides of an axis, with the duration where the axis is the time step."""
    yield from axis.changes(value)
    if axis.key == "time.step":
        yield f"time.duration={max(length.seconds(value, value), value)!r}"
