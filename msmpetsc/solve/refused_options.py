"""PETSc options that this program has no use for, which are an error.

PETSc keeps no list of the options that it knows: what no object has looked at is told once the solvers are made.
"""

import ctypes
import re
from collections.abc import Iterable, Iterator

from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.solve.petsc.library import Integer, petsc_library
from msmpetsc.solve.presets import MOST_ITERATIONS, PRESETS, in_use

READ_AT_THE_END = re.compile(
    r"^(citations|get_total_flops|mpidump|options_left|options_view|memory_view|objects_dump|malloc_\w+)$"
)
READ_WHILE_SOLVING = re.compile(r"_view|_dump|_converged_reason|_monitor|_test_jacobian|_rate")
OF_STEPPERS = re.compile(r"^(reference_|fallback_)")

OFTEN_GIVEN = {
    "ksp_view",
    "ksp_monitor",
    "ksp_max_it",
    "ksp_atol",
    "snes_view",
    "snes_monitor",
    "mat_type",
}
USUAL = OFTEN_GIVEN.union(
    *(preset.options for preset in PRESETS.values())
)  # what a misspelt option may have meant

NO_PART = "no part of this run uses this PETSc option"
BY_ERROR = "a step ends when its error is below solver.error (--error), or by solver.max_iterations"
NO_USE = {  # what PETSc would take, but not do here, or crash by; a name and its value -> what is so instead
    r"snes_(rtol|atol|divergence_tolerance|max_funcs|convergence_test|norm_schedule|force_iteration) .*": BY_ERROR,
    r"snes_stol (?!0+\.?0*$).*": BY_ERROR,  # 0 is what presets set
    r"snes_type (newtontr(dc)?|aspin|nasm|patch|ms)": "a step goes by its energy, on no DM of PETSc's; newtonls can",
    r"snes_type ksp(transpose)?only": "a linear solve is no step; newtonls makes as many as it takes",
    r"(.*_)?ksp_type fetidp": "it is for a PC of type bddc, which the operator does not have; cg can",
    r"(.*_)?pc_type deflation": "PETSc looks for a space of deflation without end; mg can",
    r"mg_\w*ksp_type pipelcg": "within a cycle it does not end; cg can",
    r"(.*_)?mat_ordering_type wbm": "PETSc aborts by it; qmd can",
    r"(.*_)?(snes|ksp|mg_\w*pc)_python_type .*": "no object of Python's can stand here",
    r"(snes_(mf|fd|lag|adapt|grid_sequence)\w*|ksp_reuse_preconditioner) .*": "solver.preset chooses the Jacobian",
    r"(.*_)?(snes|ksp)_error_if_not_converged .*": "a step that does not converge ends the run, with exit status 3",
    r"(three_columns|estimate)_.*": "the preconditioner of A, and of all that needs one, has the bare -pc_ options",
    r"ksp_view_diagonal_scale .*": "the operator is not scaled",
    r"(mat_view|ksp_view_p?mat)\w* .*": "matrices are applied, not written",
    r"(.*_)?ksp_monitor\w* (binary|hdf5|vtk|socket|string|saws)\b.*": "what it shows is text: ascii:FILE",
}

# names of options by their last words: counts, and sizes
COUNT = re.compile(
    r"(.*_)?(max_it|its|lits|cycles|levels|(jacobi|asm)_(local_)?blocks|restart|steps|anderson_m|qn_m)"
)
POSITIVE = re.compile(r"(.*_)?(rtol|divtol|damping|maxstep|minlambda|alpha|omega)")


def refuse_early(comm: MPI.Comm) -> None:
    """Raise InputError for options that are of no use in any scene (collective)."""
    lines = []
    for name, value in PETSc.Options().getAll().items():
        given = f"{OF_STEPPERS.sub('', name)} {value or ''}"
        told = [instead for option, instead in NO_USE.items() if re.fullmatch(option, given)]
        told += _bounds_passed(name, value or "")
        lines += [f"-{name}: {reason}" for reason in told[:1]]
    _refuse(comm, lines)


def _bounds_passed(name: str, value: str) -> Iterator[str]:
    """Yield the bound that the value of an option passes, if it is a number and passes any."""
    if re.search(r"(^|,)[-+]?nan\b", value, re.IGNORECASE):
        yield f"{value} is not a number"
    try:
        number = float(value)
    except ValueError:  # PETSc says whether it is none
        return
    if COUNT.fullmatch(name) and (number < 1 or number > MOST_ITERATIONS):
        yield f"a number of iterations or parts is from 1 to {MOST_ITERATIONS}, not {value}"
    if POSITIVE.fullmatch(name) and number <= 0:
        yield f"it must be above 0, not {value}"


def refuse_unused(comm: MPI.Comm, at_end: bool = False, awaited: tuple[str, ...] = ()) -> None:
    """Raise InputError for options of the user that no object has looked at (collective).

    A preset's own options another type may well leave unused.

    at_end  : before the end, options that are read while solving still have their time
    awaited : prefixes of solvers that are only made while solving
    """
    unused = [
        name
        for name in _left()
        if not in_use[name]
        and not READ_AT_THE_END.search(name)
        and (at_end or not READ_WHILE_SOLVING.search(name))
        and not name.startswith(awaited)
    ]
    _refuse(
        comm,
        (
            f"-{name}: {NO_PART}" + (did_you_mean(name, USUAL) if name not in USUAL else "")
            for name in unused
        ),
    )


def _refuse(comm: MPI.Comm, lines: Iterable[str]) -> None:
    """Raise InputError with rank 0's lines, if there are any (collective)."""
    message = comm.bcast("\n".join(lines))
    if message:
        raise InputError(message)


def _left() -> list[str]:
    """Names of the options not looked at (PetscOptionsLeftGet, which petsc4py lacks)."""
    library = petsc_library()
    strings = ctypes.POINTER(ctypes.c_char_p)
    count, names, values = Integer(), strings(), strings()
    library.PetscOptionsLeftGet(
        None, ctypes.byref(count), ctypes.byref(names), ctypes.byref(values)
    )
    left = [names[i].decode() for i in range(count.value)]
    library.PetscOptionsLeftRestore(
        None, ctypes.byref(count), ctypes.byref(names), ctypes.byref(values)
    )
    return left


def silence_options_left() -> None:
    """Keep PETSc from telling at its end which options were not used, where none was meant to be:
    newer ones do so by themselves."""
    if "options_left" not in PETSc.Options().getAll():
        PETSc.Options().setValue("options_left", "false")
