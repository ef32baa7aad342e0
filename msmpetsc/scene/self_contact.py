"""Rules of a scene whose surface meets itself: what would move it past itself unseen is refused."""

from typing import Any

from pydantic import ValidationInfo

from msmpetsc.scene.problems import rule

INTEGRATORS = ("implicit-euler", "bdf2")


def only_implicit(cls: Any, table: Any, info: ValidationInfo) -> Any:
    """Refuse integrators that take other steps than implicit ones, and obstacles that set nodes back (a validator of
    ``self_contact``)."""
    if table is None:
        return table
    integrator = getattr(info.data.get("time"), "integrator", INTEGRATORS[0])
    if integrator not in INTEGRATORS:
        raise rule(f'is for time.integrator = "implicit-euler" or "bdf2" only, not "{integrator}"', "time")
    for number, obstacle in enumerate(info.data.get("obstacle", ())):
        if obstacle.response == "exchange":
            raise rule(
                f'may not go with response = "exchange", as obstacle.{number} has it: that moves nodes past each '
                'other; "reflect" and "penalty" press',
                "obstacle",
            )
    return table
