"""The cases of a map: each method at each place of two axes, or with each named case."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from msmpetsc.scene.reading import load_scene
from msmpetsc.scene.schema import Scene
from msmpetsc.study.case import Case, Place
from msmpetsc.study.overrides import content, solver_changes, time_changes
from msmpetsc.study.schema import Axis, Map, Method, Study


@dataclass(frozen=True)
class Spot:
    """What all methods are tried on: a scene with its changes. y may be the name of a case, x is then the method's.

    steps, duration: of a run; both None for the scene's own duration
    """

    file: str
    set: tuple[str, ...]
    x: float | None
    y: float | str
    steps: int | None
    duration: float | None  # [s]
    recovers: bool = False
    options: str = ""


def map_cases(study: Study, of: Map, folder: Path, presets: Collection[str] | None = None) -> Iterator[Case]:
    """All cases of a map; ``folder`` is that of the study file. Raises InputError for a scene that is wrong."""
    methods = [method for method in study.method if not of.methods or method.label in of.methods]
    for spot in named(of) if of.case else grid(of):
        file = folder / spot.file
        scene = load_scene(file, spot.set, presets, by_user=False)
        told = content(file, scene)
        for method in methods:
            yield at(spot, method, of.name, study, file, told, scene)


def grid(of: Map) -> Iterator[Spot]:
    """The places of two axes."""
    for y, x in product(of.y.values, of.x.values):
        changes = (*of.set, *ordered([(of.x, x), (of.y, y)], of))
        yield Spot(of.file, changes, x, y, of.steps, of.duration)


def ordered(places: list[tuple[Axis, float]], of: Map) -> Iterator[str]:
    """The changes of both axes; a time step may be longer than the scene, whose duration so changes with it."""
    for axis, value in places:
        yield from axis.changes(value)
        if axis.key == "time.step":
            yield f"time.duration={of.steps * value if of.steps else max(of.duration or value, value)!r}"


def named(of: Map) -> Iterator[Spot]:
    """The named cases."""
    for case in of.case:
        own = case if case.steps or case.duration else of
        changes = (*of.set, *case.set)
        yield Spot(case.file, changes, None, case.name, own.steps, own.duration, case.recovers, case.options)


def at(spot: Spot, method: Method, name: str, study: Study, file: Path, told: str, scene: Scene) -> Case:
    """The run of a method at a place; ``told``: digest of the scene and its files."""
    solves = method.integrator != "verlet"
    options = " ".join(filter(None, (method.options, spot.options if solves else "")))
    place = Place(name, method.label if spot.x is None else spot.x, spot.y, spot.recovers)
    step = scene.time.step
    case = Case(
        name, file, told, spot.set, method.integrator, method.preset if solves else "", options, None, step, None,
        method.error, method.max_iterations, timeout=study.timeout, label=method.label, place=place,
    )  # fmt: skip
    duration = spot.steps * step if spot.steps else spot.duration or scene.time.duration
    changes = (*spot.set, *solver_changes(case, scene), *time_changes(case, max(duration, step), 1, scene))
    return Case(**vars(case) | {"set": changes})
