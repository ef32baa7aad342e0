"""Rules of a scene that depend on its integrator.

In statics, where nothing moves, much has no meaning; exchange and a surface that meets itself want implicit steps.
"""

from collections.abc import Iterator
from typing import Any, Final

from msmpetsc.scene.problems import Broken, rule

STATIC: Final = "static"  # time.integrator
IMPLICIT = ("implicit-euler", "bdf2")
OF_TIME = ("path", "times", "start", "stop")  # keys of what comes, goes or moves


def one_state(data: Any) -> Any:
    """Return a scene's data, unchecked, with its one state where nothing changes in time: it wants no step or duration.

    Of step and duration, either says how long the other is.
    """
    time = data.get("time") if isinstance(data, dict) else None
    if not isinstance(time, dict) or time.get("integrator") != STATIC:
        return data
    for load in _loads(data):
        if isinstance(load.get("total"), dict) or "function" in load or any(name in load for name in OF_TIME):
            return data
    one = time.get("step", time.get("duration", 1.0))
    return {**data, "time": {"step": one, "duration": one, **time}}


def _loads(tables: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield what moves or presses the bodies of a scene, unchecked."""
    for name in ("anchor", "force", "obstacle", "body"):
        given = tables.get(name)
        for table in given if isinstance(given, list | tuple) else ():
            if isinstance(table, dict):
                yield from _loads(table) if name == "body" else [table]


def unlike_the_integrator(scene: Any) -> Iterator[Broken]:
    """Yield the rules that tables of a scene break by its integrator."""
    integrator = scene.time.integrator
    if scene.material.retardation_time and integrator not in IMPLICIT:
        words = f'may not have integrator = "{integrator}" where material.retardation_time is given: '
        yield "time", rule(f'{words}"implicit-euler" and "bdf2" have', "material")
    if integrator == STATIC:
        yield from _moving(scene)
    if scene.touching and integrator not in IMPLICIT:
        words = f'is for time.integrator = "implicit-euler" or "bdf2" only, not "{integrator}"'
        barrier = "" if scene.self_contact else 'with response = "barrier" '
        yield "self_contact" if scene.self_contact else "obstacle", rule(barrier + words, "time")
    for number, obstacle in enumerate(scene.obstacle):
        if obstacle.response != "exchange":
            continue
        if integrator == "bdf2":  # a step would see that nodes were set back
            words = f'may not be "bdf2" with response = "exchange", as obstacle.{number} has it: it sets nodes back by '
            yield "obstacle", rule(f'{words}one step; "reflect" and "penalty" go', "time")
        if scene.touching:
            words = f'may not have response = "exchange" where surfaces meet, as obstacle.{number} has it: that moves '
            yield "obstacle", rule(f'{words}nodes past each other; "reflect" and "penalty" press', "self_contact")


def _moving(scene: Any) -> Iterator[Broken]:
    """Yield the rules that a scene of statics breaks by what moves, depends on motion or rubs."""
    if scene.material.damping:
        words = f'may not have integrator = "{STATIC}" where material.damping is given: nothing moves'
        yield "time", rule(words, "material")
    bodies = [("body", f"body.{number}.", body) for number, body in enumerate(scene.body)]
    for key, whose, tables in [("", "", scene), *bodies]:
        if tables.start is not None and (any(tables.start.velocity) or any(tables.start.spin)):
            words = f'{key and f"{whose}start "}may have no velocity or spin where time.integrator = "{STATIC}": '
            yield key or "start", rule(f"{words}there is no inertia", "time")
        for number, force in enumerate(tables.force):
            if force.function is not None:
                words = f'may be no function where time.integrator = "{STATIC}", as {whose}force.{number} is: it is '
                yield key or "force", rule(f"{words}that of the state before, which is not at rest under it", "time")
    for number, obstacle in enumerate(scene.obstacle):
        if obstacle.response not in ("penalty", "barrier"):
            words = f'may not {obstacle.response} where time.integrator = "{STATIC}", as obstacle.{number} does: '
            yield "obstacle", rule(f'{words}nothing strikes it; response = "penalty" presses', "time")
        if obstacle.friction:
            words = f'may have no friction where time.integrator = "{STATIC}", as obstacle.{number} has: it depends on '
            yield "obstacle", rule(f'{words}the way there; time.until = "rest" ends a run in motion there', "time")
