"""PETSc options that this program has no use for: an error that says what to give instead, as early as can be known.

PETSc keeps no list of the options that it knows: what no object has looked at is told once the solvers are made.
"""

import ctypes
import difflib
import re
from collections.abc import Collection, Iterable

from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.solve.petsc.library import Integer, petsc_errors, petsc_library
from msmpetsc.solve.presets import PRESETS, Preset, SolverOptions

READ_AT_THE_END = re.compile(
    r"^(citations|get_total_flops|mpidump|options_left|options_view|memory_view|objects_dump|malloc_\w+)$"
)
READ_WHILE_SOLVING = re.compile(r"_view|_dump|_converged_reason|_monitor|_test_jacobian|_rate")
OF_STEPPERS = re.compile(r"^(reference_|fallback_)")

OFTEN_GIVEN = {"ksp_view", "ksp_monitor", "ksp_max_it", "ksp_atol", "snes_view", "snes_monitor", "mat_type", "mat_view"}
USUAL = OFTEN_GIVEN.union(*(preset.options for preset in PRESETS.values()))  # what a misspelt option may have meant

NO_PART = "no part of this run uses this PETSc option"
BY_ERROR = "a step ends when its error is below solver.error (--error), or by solver.max_iterations"
NO_DIFFERENCES = "Hessians are applied spring by spring already, without differences"
NO_LAG = "each solve takes the Hessian of its iterate; A is constant, and made ready once"
TRUST_REGION = "PETSc's trust region goes by |F|, which has minima that the energy has not; newtonls goes by the energy"
NO_USE = {  # names -> what is so instead
    r"ts_(dt|init_dt)": "the time step is time.step",
    r"ts_(max_time|final_time|max_steps|init_time)": "how long a run is say time.duration and --frames",
    r"ts_.*": "steps are no TS of PETSc's: time.integrator, time.step and time.duration say how they are taken",
    r"(dm|da)_.*": "the lattice is no DM of PETSc's: cages.count or cages.cell_size say how fine it is",
    r"tao_.*": "a step is minimised by a SNES: solver.preset, or -snes_type, say how",
    r"snes_(rtol|atol|divergence_tolerance|max_funcs|convergence_test|norm_schedule)": BY_ERROR,
    r"snes_force_iteration": BY_ERROR + "; a first guess that is near enough needs no iteration",
    r"snes_(mf|mf_.*|fd|fd_.*)": NO_DIFFERENCES,
    r"snes_lag_.*|ksp_reuse_preconditioner": NO_LAG,
    r"(snes|ksp)_error_if_not_converged": "a step that does not converge ends the run already, with exit status 3",
    r"(three_columns|estimate)_.*": "the preconditioner of A, and of all that needs one, has the bare -pc_ options",
    r"ksp_view_diagonal_scale": "the operator is not scaled",
    r"snes_(grid_sequence|adapt_.*)": "there is one lattice: cages.count or cages.cell_size say how fine it is",
}
NO_USE_AS = [  # names, values, what is so instead; the last two would crash
    ("snes_stol", r"(?!0+\.?0*$).*", BY_ERROR),  # 0 is what presets set
    ("snes_type", r"newtontr(dc)?", TRUST_REGION),
    ("snes_type", r"aspin|nasm|patch", "it needs a DM of PETSc's, and the lattice is none"),
    (r"(.*_)?ksp_monitor\w*", r"(binary|hdf5|vtk|socket|string|saws)\b.*", "what it shows is text: ascii:FILE"),
]


def refuse_early(comm: MPI.Comm, ours: Collection[str]) -> None:
    """Raise InputError for options of the user that cannot be of use, whatever the scene (collective).

    ours : the command's own options, "--preset"
    """
    lines = [_no_use(name, value) for name, value in PETSc.Options().getAll().items()]
    lines += [f"-{name}: {NO_PART}{_ours(name, ours)}" for name in _left() if _ours(name, ours)]
    _refuse(comm, filter(None, lines))


def refuse_bad_values(solvers: dict[str, tuple[Preset, int]]) -> None:
    """Raise InputError for types and values of options that PETSc's solvers refuse, before there is anything to solve.

    solvers : prefix of their options -> preset and budget of iterations
    """
    if "help" in PETSc.Options().getAll():  # once is enough
        return
    for prefix, (preset, budget) in solvers.items():
        options = SolverOptions(preset, prefix, budget)
        objects: list[PETSc.Object] = []
        try:
            with petsc_errors("PETSc refuses its options", further=Exception):
                for kind in (PETSc.Mat, PETSc.PC, PETSc.SNES):
                    objects.append(kind().create(PETSc.COMM_SELF))
                    objects[-1].setOptionsPrefix(prefix)
                    objects[-1].setFromOptions()
        finally:
            for owned in objects:
                owned.destroy()
            options.withdraw()


def refuse_unused(comm: MPI.Comm, ours: set[str], at_end: bool = False, awaited: tuple[str, ...] = ()) -> None:
    """Raise InputError for options of the user that no object has looked at (collective).

    ours    : names of the preset's own options, which another type may well leave unused
    at_end  : before the end, options that are read while solving still have their time
    awaited : prefixes of solvers that are only made while solving
    """
    unused = [
        name
        for name in _left()
        if name not in ours
        and not READ_AT_THE_END.search(name)
        and (at_end or not READ_WHILE_SOLVING.search(name))
        and not name.startswith(awaited)
    ]
    lines = (f"-{name}: {NO_PART}" + (did_you_mean(name, USUAL) if name not in USUAL else "") for name in unused)
    _refuse(comm, lines)


def _refuse(comm: MPI.Comm, lines: Iterable[str]) -> None:
    """Raise InputError with rank 0's lines, if there are any (collective)."""
    message = comm.bcast("\n".join(lines))
    if message:
        raise InputError(message)


def _no_use(name: str, value: str | None) -> str | None:
    """Why an option of this name and value is refused; None if it is not."""
    bare = OF_STEPPERS.sub("", name)
    for names, values, instead in NO_USE_AS:
        if re.fullmatch(names, bare) and re.fullmatch(values, value or ""):
            return f"-{name} {value or ''}: {instead}".replace(" :", ":")
    return next((f"-{name}: {instead}" for names, instead in NO_USE.items() if re.fullmatch(names, bare)), None)


def _ours(name: str, ours: Collection[str]) -> str:
    """Words on the command's own option that was given with one dash, or with a letter too many; "" if it was not."""
    valid = {own.lstrip("-").replace("-", "_"): own for own in ours}
    near = [name] if name.replace("-", "_") in valid else difflib.get_close_matches(name, valid, 1) * ("_" not in name)
    return f", did you mean {valid[near[0].replace('-', '_')]!r}?" if near else ""


def _left() -> list[str]:
    """Names of the options not looked at (PetscOptionsLeftGet, which petsc4py lacks)."""
    library = petsc_library()
    strings = ctypes.POINTER(ctypes.c_char_p)
    count, names, values = Integer(), strings(), strings()
    library.PetscOptionsLeftGet(None, ctypes.byref(count), ctypes.byref(names), ctypes.byref(values))
    left = [names[i].decode() for i in range(count.value)]
    library.PetscOptionsLeftRestore(None, ctypes.byref(count), ctypes.byref(names), ctypes.byref(values))
    return left


def silence_options_left() -> None:
    """Keep PETSc from telling at its end which options were not used, where none was meant to be:
    newer ones do so by themselves."""
    if "options_left" not in PETSc.Options().getAll():
        PETSc.Options().setValue("options_left", "false")
