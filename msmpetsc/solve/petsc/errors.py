"""Errors of PETSc about options that it cannot use, as the one line of an InputError."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from petsc4py import PETSc

from msmpetsc.errors import InputError, StepFailed, did_you_mean

NOT_CONVERGED = 91  # PETSC_ERR_NOT_CONVERGED, of an inner solver that was asked to make an error of it


@contextmanager
def petsc_errors(
    what: str, abandon: Callable[[], None] = lambda: None, further: type[Exception] = ImportError
) -> Iterator[None]:
    """Make PETSc's errors in the block, or in the function decorated, an InputError ``what``: its last words.

    ImportError is that of an object of type python whose context is not there. A solver that did not converge, where an
    option made that an error, becomes StepFailed.

    abandon : called after such an error
    further : more exceptions that come of options here
    """
    try:
        yield
    except (PETSc.Error, ImportError, further) as error:  # type: ignore[misc]  # petsc4py has no types
        # No other name for it: a frame that holds an exception is held by it, and PETSc's objects with both, for ever.
        # Of newer petsc4py, what Python code within PETSc raised is the cause of its own error.
        cause = error.__cause__
        if cause is not None and not isinstance(cause, (PETSc.Error, ImportError, further)):
            raise cause  # noqa: B904 (the error itself, not another)
        abandon()
        if getattr(error, "ierr", 0) == NOT_CONVERGED:
            raise StepFailed(f"did not converge: {last_words(error)}", "linear solve") from None
        raise InputError(f"{what}: {last_words(cause or error)}") from None


def last_words(error: BaseException) -> str:
    """Message of a PETSc error, without the calls it came through."""
    lines = str(error).splitlines()
    said = [line.partition("] ")[2] for line in lines if line.startswith("[") and "() at " not in line]
    words = said[-1] if said else lines[0]
    return words + _nearest_type(words)


def _nearest_type(words: str) -> str:
    """Return the nearest type of solver where PETSc has not found one: ", did you mean 'pipecg'?"."""
    wanted = re.search(r"requested (KSP|PC|SNES) type (\w+)", words)
    if wanted is None:
        return ""
    types = getattr(PETSc, wanted[1]).Type
    return did_you_mean(wanted[2], [name for name in vars(types).values() if isinstance(name, str)])
