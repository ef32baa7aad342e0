"""The exceptions a user can meet. Each is one clear line; the class gives the exit status."""

import difflib
from collections.abc import Iterable


class MsmpetscError(Exception):
    """Base of all expected failures; ``exit_status`` is what the command line returns."""

    exit_status = 1


class InputError(MsmpetscError):
    """What the user gave cannot be used: scene, mesh, option or file."""

    exit_status = 2


class StepFailed(MsmpetscError):
    """A time step did not converge."""

    exit_status = 3


def nearest(name: str, valid: Iterable[str]) -> str | None:
    """The valid name nearest to a wrong one; None where none is near."""
    return next(iter(difflib.get_close_matches(name, list(valid), n=1)), None)


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """", did you mean 'x'?" with the nearest valid name; empty where none is near."""
    near = nearest(name, valid)
    return f", did you mean {near!r}?" if near else ""
