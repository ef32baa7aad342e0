"""The exceptions a user can meet. Each is one clear line; the class gives the exit status."""

import difflib
from collections.abc import Iterable
from errno import EDQUOT, EFBIG, ENOSPC


class MsmpetscError(Exception):
    """Base of all expected failures; ``exit_status`` is what the command line returns."""

    exit_status = 1
    on_all_ranks = False  # whether every rank raises it, as far as is known


class InputError(MsmpetscError):
    """What the user gave cannot be used: scene, mesh, option or file."""

    exit_status = 2


class StepFailed(MsmpetscError):
    """A time step did not converge, or what came of it is no motion of a body.

    kind : "iterations" (at their limit), "line search", "linear solve", "not finite", "energy" (grew without
        work), "unstable" (explicit substeps)
    frame : number of the step, once it is known
    """

    exit_status = 3

    def __init__(self, message: str, kind: str = "iterations", frame: int | None = None):
        super().__init__(message)
        self.kind, self.frame = kind, frame


class StepStopped(MsmpetscError):
    """A signal ended a time step between two of its iterations; the state before it stands."""


PETSC_OUT_OF_MEMORY = 55  # PETSc.Error.ierr
NO_ROOM = ENOSPC, EDQUOT, EFBIG
EXTRAS = {  # what pyproject.toml's extras bring, by the names they are imported by
    "run": (
        "petsc4py",
        "mpi4py",
        "scipy",
        "numba",
        "pydantic",
        "tomli_w",
        "trimesh",
        "igl",
        "pooch",
        "psutil",
        "tqdm",
    ),
    "mesh": ("meshio", "manifold3d", "fast_simplification"),
    "render": ("pyvista", "scipy", "pydantic", "tomli_w", "trimesh", "igl", "tqdm"),
    "study": ("pandas", "vl_convert", "jinja2", "tomlkit"),
    "contact": ("ipctk",),
    "movie": ("imageio", "imageio_ffmpeg"),
    "usd": ("pxr",),
    "repair": ("pymeshfix",),
    "cuda": ("cupy",),
    "peers": ("newton",),
}


def as_expected(error: Exception, extra: str = "run") -> MsmpetscError | None:
    """Return the error as one of ours, if a user can meet it: lack of memory is one.

    extra : the one that is named for a package which several extras bring
    """
    if isinstance(error, MemoryError) or getattr(error, "ierr", None) == PETSC_OUT_OF_MEMORY:
        reason = one_line(error)
        return InputError(
            f"there is not enough memory ({reason}): fewer cells, or ranks on more machines, need less"
        )
    if isinstance(error, OSError) and error.errno in NO_ROOM:  # in a folder of temporary files, say
        return InputError(f"{error.filename or 'the output'} cannot be written: {error.strerror}")
    if (
        isinstance(error, OSError) and error.filename
    ):  # an mpiexec that is not there, a folder that cannot be made
        return InputError(f"{error.filename}: {error.strerror}")
    if isinstance(error, ModuleNotFoundError) and extra_of(error.name or ""):
        return missing_package(error.name or "", extra)
    return error if isinstance(error, MsmpetscError) else None


def missing_package(name: str, extra: str = "run") -> InputError:
    """Return the error that says which extra brings a package that is not installed."""
    return InputError(
        f"{name} is not installed: pip install 'msmpetsc[{extra_of(name, extra)}]' brings it"
    )


def extra_of(module: str, first: str = "run") -> str | None:
    """Return the extra that brings a module, the first if several do; None for any other."""
    package = module.partition(".")[0]
    return next((extra for extra in (first, *EXTRAS) if package in EXTRAS[extra]), None)


def nearest(name: str, valid: Iterable[str]) -> str | None:
    """Return the valid name nearest to a wrong one; None where none is near."""
    return next(iter(difflib.get_close_matches(name, list(valid), n=1)), None)


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """Return ", did you mean 'x'?" with the nearest valid name; nothing where none is near."""
    near = nearest(name, valid)
    return f", did you mean {near!r}?" if near else ""


def one_line(error: Exception, length: int = 160) -> str:
    """Return the first line of what a library says went wrong, in printable characters."""
    return printable((str(error).strip().splitlines() or [type(error).__name__])[0], length)


def printable(text: str, length: int = 160) -> str:
    """Return the text, cut, without what would act on a terminal."""
    return "".join(c if c.isprintable() else "?" for c in text[:length])
