"""Expected errors of the package: a line for the user, and an exit status for each class."""

import difflib
from collections.abc import Iterable
from errno import EDQUOT, EFBIG, ENOSPC
from pathlib import Path

# exit statuses of the command line; app.signals has the statuses of stopped runs
STATUS_BUG, STATUS_REFUSED, STATUS_FAILED, STATUS_INTERRUPTED = 1, 2, 3, 130


class MsmpetscError(Exception):
    """Base class of all expected errors.

    exit_status  : returned by the command line
    on_all_ranks : whether every rank is known to raise this error
    """

    exit_status = STATUS_BUG
    on_all_ranks = False


class InputError(MsmpetscError):
    """A scene, mesh, option or file that cannot be used."""

    exit_status = STATUS_REFUSED


class StepFailed(MsmpetscError):
    """A time step that did not converge, or whose result is not physical.

    kind  : "iterations" (limit reached), "line search", "linear solve", "not finite",
        "energy" (grew without work) or "unstable" (explicit substeps)
    frame : number of the step; None until it is known
    """

    exit_status = STATUS_FAILED

    def __init__(self, message: str, kind: str = "iterations", frame: int | None = None):
        super().__init__(message)
        self.kind, self.frame = kind, frame


class StepStopped(MsmpetscError):
    """A time step that a signal ended between two iterations; the state before it is kept."""


# PETSc.Error.ierr of a failed allocation (PETSC_ERR_MEM)
PETSC_OUT_OF_MEMORY = 55
NO_ROOM = ENOSPC, EDQUOT, EFBIG
# import names of the packages in each extra of pyproject.toml
EXTRAS = {
    "run": (
        "petsc4py", "mpi4py", "scipy", "numba", "pydantic", "tomli_w", "trimesh", "igl", "pooch",
        "psutil", "tqdm",
    ),
    "mesh": ("meshio", "manifold3d", "fast_simplification"),
    "render": ("pyvista", "scipy", "pydantic", "tomli_w", "trimesh", "igl", "tqdm"),
    "study": ("pandas", "vl_convert", "jinja2", "tomlkit"),
    "contact": ("ipctk",),
    "movie": ("imageio_ffmpeg",),
    "usd": ("pxr",),
    "repair": ("pymeshfix",),
    "cuda": ("cupy",),
}  # fmt: skip


def as_expected(error: Exception, extra: str = "run") -> MsmpetscError | None:
    """Return the MsmpetscError for an error that a user may cause; None for a program fault.

    extra : named in the message if several extras bring a missing package
    """
    if isinstance(error, MemoryError) or getattr(error, "ierr", None) == PETSC_OUT_OF_MEMORY:
        reason = one_line(error)
        return InputError(
            f"there is not enough memory ({reason}): use fewer cells, or ranks on more machines"
        )
    # for example a missing mpiexec, a folder that cannot be created, or a full disk
    if isinstance(error, OSError) and (error.filename or error.errno in NO_ROOM):
        return InputError(f"{error.filename or 'the output'}: {error.strerror}")
    if isinstance(error, ModuleNotFoundError) and extra_of(error.name or ""):
        return missing_package(error.name or "", extra)
    return error if isinstance(error, MsmpetscError) else None


def missing_package(name: str, extra: str = "run") -> InputError:
    """Return the error for a package that is not installed, with the extra to install."""
    return InputError(
        f"{name} is not installed: pip install 'msmpetsc[{extra_of(name, extra)}]' brings it"
    )


def extra_of(module: str, first: str = "run") -> str | None:
    """Return the extra that brings a module, ``first`` if it does; None for an unknown module."""
    package = module.partition(".")[0]
    return next((extra for extra in (first, *EXTRAS) if package in EXTRAS[extra]), None)


def refuse_pipe(path: Path) -> None:
    """Raise InputError for a pipe or a device, which may have no end."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise InputError(f"{path} is a pipe or a device, not a file")


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """Return ", did you mean 'x'?" with the most similar valid name, or an empty string."""
    near = difflib.get_close_matches(name, list(valid), n=1)
    return f", did you mean {near[0]!r}?" if near else ""


def body_names(count: int) -> list[str]:
    """Return the names of ``count`` bodies of a scene in messages."""
    return [f"body.{number}" if count > 1 else "the body" for number in range(count)]


def one_line(error: Exception, length: int = 160) -> str:
    """Return the first line of an error's message in printable characters."""
    return printable((str(error).strip().splitlines() or [type(error).__name__])[0], length)


def printable(text: str, length: int = 160) -> str:
    """Return the text cut to a length, with control characters replaced by question marks."""
    return "".join(c if c.isprintable() else "?" for c in text[:length])
