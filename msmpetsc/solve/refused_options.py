"""Errors for PETSc options that the run does not use.

PETSc keeps no list of known options. Therefore unused options are found after the solvers have read
the options database.
"""

import ctypes
import re
from collections.abc import Iterable, Iterator

from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.solve.petsc.library import petsc_library
from msmpetsc.solve.presets import MOST_ITERATIONS, PRESETS, in_use

READ_AT_THE_END = re.compile(
    r"^(citations|get_total_flops|mpidump|options_left|options_view|memory_view|objects_dump"
    r"|malloc_\w+)$"
)
READ_WHILE_SOLVING = re.compile(r"_view|_dump|_converged_reason|_monitor|_test_jacobian|_rate")
SOLVER_PREFIX = re.compile(r"^(reference_|fallback_)")

OFTEN_GIVEN = {
    "ksp_view",
    "ksp_monitor",
    "ksp_max_it",
    "ksp_atol",
    "snes_view",
    "snes_monitor",
    "mat_type",
}
# options that a misspelt name is compared with
COMMON_OPTIONS = OFTEN_GIVEN.union(*(preset.options for preset in PRESETS.values()))

NO_PART = "no part of this run uses this PETSc option"
BY_ERROR = "a step ends when its error is below solver.error (--error), or by solver.max_iterations"
# pattern of an option and its value that PETSc ignores here or crashes with -> reason
NO_USE = {
    r"snes_(rtol|atol|divergence_tolerance|max_funcs|convergence_test|norm_schedule"
    r"|force_iteration) .*": BY_ERROR,
    # Presets themselves set 0.
    r"snes_stol (?!0+\.?0*$).*": BY_ERROR,
    r"snes_type (newtontr(dc)?|aspin|nasm|patch|ms)": (
        "it needs a DM of PETSc or ignores the energy of a step; newtonls can"
    ),
    r"snes_type ksp(transpose)?only": ("a step needs more than one linear solve; newtonls can"),
    r"(.*_)?ksp_type fetidp": (
        "it needs a PC of type bddc, which the operator does not support; cg can"
    ),
    r"(.*_)?pc_type deflation": "PETSc never finds a deflation space; mg can",
    r"mg_\w*ksp_type pipelcg": "it does not end within a cycle; cg can",
    r"(.*_)?mat_ordering_type wbm": "it makes PETSc abort; qmd can",
    r"(.*_)?(snes|ksp|mg_\w*pc)_python_type (?!msmpetsc\.).*": "no Python object can be used here",
    r"(snes_(mf|fd|lag|adapt|grid_sequence)\w*|ksp_reuse_preconditioner) .*": (
        "solver.preset chooses the Jacobian"
    ),
    r"(.*_)?(snes|ksp)_error_if_not_converged .*": (
        "a step that does not converge ends the run, with exit status 3"
    ),
    r"(three_columns|estimate)_.*": (
        "every preconditioner of A is set by the -pc_ options without a prefix"
    ),
    r"ksp_view_diagonal_scale .*": "the operator is not scaled",
    r"(mat_view|ksp_view_p?mat)\w* .*": "matrices are applied, not written",
    r"(.*_)?ksp_monitor\w* (binary|hdf5|vtk|socket|string|saws)\b.*": (
        "the monitor prints text: ascii:FILE"
    ),
}

# pattern of the names of options whose value is a count
COUNT = re.compile(
    r"(.*_)?(max_it|its|lits|cycles|levels|(jacobi|asm)_(local_)?blocks|restart|steps|anderson_m|qn_m)"
)
# pattern of the names of options whose value is a positive number
POSITIVE = re.compile(r"(.*_)?(rtol|divtol|damping|maxstep|minlambda|alpha|omega)")


def refuse_early(comm: MPI.Comm) -> None:
    """Raise InputError for options that no scene can use (collective)."""
    lines = []
    for name, value in PETSc.Options().getAll().items():
        given = f"{SOLVER_PREFIX.sub('', name)} {value or ''}"
        reasons = [reason for option, reason in NO_USE.items() if re.fullmatch(option, given)]
        reasons += _bounds_passed(name, value or "")
        lines += [f"-{name}: {reason}" for reason in reasons[:1]]
    _refuse(comm, lines)


def _bounds_passed(name: str, value: str) -> Iterator[str]:
    """Yield a message if an option's number is missing or outside its bounds."""
    # Without a number PETSc drops the option, and with it the preset's value.
    if not value and (COUNT.fullmatch(name) or POSITIVE.fullmatch(name)):
        yield "it needs a number"
    if re.search(r"(^|,)[-+]?nan\b", value, re.IGNORECASE):
        yield f"{value} is not a number"
    try:
        number = float(value)
    # PETSc itself reports a text in place of a number.
    except ValueError:
        return
    if COUNT.fullmatch(name) and (number < 1 or number > MOST_ITERATIONS):
        yield f"a number of iterations or parts is from 1 to {MOST_ITERATIONS}, not {value}"
    if POSITIVE.fullmatch(name) and number <= 0:
        yield f"it must be above 0, not {value}"
    if name.endswith("rtol") and number >= 1:
        yield f"a relative tolerance must be below 1, not {value}"


def refuse_unused(comm: MPI.Comm, at_end: bool = False, awaited: tuple[str, ...] = ()) -> None:
    """Raise InputError for options of the user that no object has read (collective).

    Options that a preset sets may remain unused.

    at_end  : whether the run has ended; before, options that are read while solving may be unused
    awaited : prefixes of solvers that the run may yet make
    """
    unused = [
        name
        for name in PETSc.Options().getAll()
        if not in_use[name]
        and not _is_read(name)
        and not READ_AT_THE_END.search(name)
        and (at_end or not READ_WHILE_SOLVING.search(name))
        and not name.startswith(awaited)
    ]
    lines = []
    for name in unused:
        guess = "" if name in COMMON_OPTIONS else did_you_mean(name, COMMON_OPTIONS)
        lines.append(f"-{name}: {NO_PART}{guess}")
    _refuse(comm, lines)


def _refuse(comm: MPI.Comm, lines: Iterable[str]) -> None:
    """Raise InputError with the lines of rank 0, if any (collective)."""
    message = comm.bcast("\n".join(lines))
    if message:
        raise InputError(message)


def _is_read(name: str) -> bool:
    """Return whether an object has read an option (PetscOptionsUsed)."""
    used = ctypes.c_int()
    petsc_library().PetscOptionsUsed(None, name.encode(), ctypes.byref(used))
    return bool(used)


def silence_options_left() -> None:
    """Turn off PETSc's own report of unused options, unless the user asks for it.

    Newer releases of PETSc print the report by default.
    """
    if "options_left" not in PETSc.Options().getAll():
        PETSc.Options().setValue("options_left", "false")
