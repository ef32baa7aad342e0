"""Rules of a scene that depend on its integrator: in statics, where nothing moves, much has no meaning; exchange and a
surface that meets itself want implicit steps."""

from collections.abc import Iterator
from typing import Any, Final

from pydantic import ValidationInfo

from msmpetsc.scene.problems import rule

STATIC: Final = "static"  # time.integrator
IMPLICIT = ("implicit-euler", "bdf2")
OF_TIME = ("path", "times", "start", "stop")  # keys of what comes, goes or moves


def one_state(data: Any) -> Any:
    """Return a scene's data, unchecked, with its one state where nothing changes in time: it wants no step or duration.

    Of step and duration, either says how long the other is.
    """
    time = data.get("time") if isinstance(data, dict) else None
    if not isinstance(time, dict) or time.get("integrator") != STATIC or any(map(_changes, _loads(data))):
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


def _changes(load: dict[str, Any]) -> bool:
    """Return whether a load may not be the same at all times, as a function of the user's may not."""
    return isinstance(load.get("total"), dict) or "function" in load or any(name in load for name in OF_TIME)


def _is_static(info: ValidationInfo) -> bool:
    return getattr(info.data.get("time"), "integrator", None) == STATIC


def no_wait(cls: Any, until: str, info: ValidationInfo) -> str:
    """Refuse to wait for rest where there is nothing else (a validator of ``time.until``)."""
    if until == "rest" and info.data.get("integrator") == STATIC:
        raise rule(f'has no meaning for integrator = "{STATIC}": each state is at rest', "integrator")
    return until


def no_damping(cls: Any, time: Any, info: ValidationInfo) -> Any:
    """Refuse damping where nothing moves (a validator of ``time``)."""
    if time.integrator == STATIC and getattr(info.data.get("material"), "damping", 0.0):
        raise rule(f'may not have integrator = "{STATIC}" where material.damping is given: nothing moves', "material")
    return time


def no_motion(cls: Any, start: Any, info: ValidationInfo) -> Any:
    """Refuse a start in motion (a validator of ``start``)."""
    refuse_motion(start, info)
    return start


def refuse_motion(start: Any, info: ValidationInfo, whose: str = "") -> None:
    """Raise a broken rule for a start in motion; ``whose`` it is, for the message."""
    if start is not None and _is_static(info) and (any(start.velocity) or any(start.spin)):
        words = f'{whose}may have no velocity or spin where time.integrator = "{STATIC}": there is no inertia'
        raise rule(words, "time")


def obstacles_fit(cls: Any, obstacles: Any, info: ValidationInfo) -> Any:
    """Refuse obstacles that do not go with the integrator (a validator of ``obstacle``).

    The paper's exchange sets nodes back, which a step of BDF2 would see; in statics nothing bounces or rubs.
    """
    integrator = getattr(info.data.get("time"), "integrator", None)
    for number, obstacle in enumerate(obstacles):
        if integrator == "bdf2" and obstacle.response == "exchange":
            raise rule(
                f'may not be "bdf2" with response = "exchange", as obstacle.{number} has it: it sets nodes back by '
                'one step; "reflect" and "penalty" go',
                "time",
            )
        if integrator == STATIC and obstacle.response != "penalty":
            raise rule(
                f'may not {obstacle.response} where time.integrator = "{STATIC}", as obstacle.{number} does: nothing '
                'strikes it; response = "penalty" presses',
                "time",
            )
        if integrator == STATIC and obstacle.friction:
            raise rule(
                f'may have no friction where time.integrator = "{STATIC}", as obstacle.{number} has: it depends on the '
                'way there; time.until = "rest" ends a run in motion there',
                "time",
            )
    return obstacles


def no_functions(cls: Any, forces: Any, info: ValidationInfo) -> Any:
    """Refuse forces that go by the state (a validator of ``force``)."""
    refuse_functions(forces, info)
    return forces


def refuse_functions(forces: Any, info: ValidationInfo, whose: str = "") -> None:
    """Raise a broken rule for forces that go by the state; ``whose`` they are, for the message."""
    for number, force in enumerate(forces if _is_static(info) else ()):
        if force.function is not None:
            raise rule(
                f'may be no function where time.integrator = "{STATIC}", as {whose}force.{number} is: it is that of '
                "the state before, which is not at rest under it",
                "time",
            )


def only_implicit(cls: Any, table: Any, info: ValidationInfo) -> Any:
    """Refuse integrators that take other steps than implicit ones, and obstacles that set nodes back (a validator of
    ``self_contact``)."""
    if table is None:
        return table
    integrator = getattr(info.data.get("time"), "integrator", IMPLICIT[0])
    if integrator not in IMPLICIT:
        raise rule(f'is for time.integrator = "implicit-euler" or "bdf2" only, not "{integrator}"', "time")
    for number, obstacle in enumerate(info.data.get("obstacle", ())):
        if obstacle.response == "exchange":
            raise rule(
                f'may not go with response = "exchange", as obstacle.{number} has it: that moves nodes past each '
                'other; "reflect" and "penalty" press',
                "obstacle",
            )
    return table
