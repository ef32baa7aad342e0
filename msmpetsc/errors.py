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


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """", did you mean 'x'?" with the valid name nearest to a wrong one; empty where none is near."""
    near = difflib.get_close_matches(name, list(valid), n=1)
    return f", did you mean {near[0]!r}?" if near else ""
