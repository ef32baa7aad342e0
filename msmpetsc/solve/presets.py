"""Presets: a method is a set of PETSc options on the one SNES of solve.nonlinear.step.

Each option is only a default: the user's own option of that name wins. With A constant, Newton's
method is the paper's local/global iteration x <- x - A^(-1) F(x) (Eq. 17). The bare -ksp_ and -pc_
options always mean the linear solve with A (or with the true Hessian, for ``newton``).
"""

from collections import Counter
from dataclasses import dataclass, replace

from petsc4py import PETSc

from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.extensions import PRESETS as ADDED
from msmpetsc.solve.petsc.words import options_of, words_of


@dataclass(frozen=True)
class Preset:
    """A method as a set of PETSc options.

    about        : when to use it
    options      : PETSc's, without the dash
    projected    : so many iterations, of a step and of what follows a climb, are without its negative parts
    iterations   : a fixed number of them, from y on, is the method as published; None: to the error target, from the
        best of several guesses, and ksp_rtol is only the tightest of a linear solve: less where the step needs less
    chooses      : pc_type is only what it begins with, where multigrid of the Hessian is not worth its while
    """

    about: str
    options: dict[str, str]
    true_hessian: bool = False  # the Jacobian is the true Hessian of g, not the constant A
    projected: int = 0
    start_from_b: bool = False  # CG starts from x = b, as in the paper's Algorithm 1
    iterations: int | None = None
    chooses: bool = False


# Iterations of CG in a step, and the most of any option that counts; so each step ends.
MOST_ITERATIONS = 100_000
CHOLESKY = {"ksp_type": "preonly", "pc_type": "cholesky", "pc_factor_mat_solver_type": "mumps"}
JACOBI_CG = {"ksp_type": "cg", "pc_type": "jacobi", "ksp_norm_type": "natural"}
NO_STOP_BY_SIZE = {"snes_stol": "0"}  # a step stops by its error alone, and so must a line search
PLAIN = {
    "snes_type": "newtonls",
    "snes_linesearch_type": "basic",
    "snes_max_it": "1000",
    **NO_STOP_BY_SIZE,
}
MANY = "3000"  # a hard step takes hundreds of newton's cheap iterations (tests/test_recovery.py), and gets there
LATTICE_MULTIGRID = {  # the cycle of -pc_type mg
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_ksp_max_it": "1",
    "mg_coarse_ksp_type": "preonly",
    "mg_coarse_pc_type": "redundant",
    "mg_coarse_redundant_pc_type": "cholesky",
    "mg_coarse_redundant_pc_factor_mat_solver_type": "petsc",  # on the CPU: cuSPARSE's took most of a cycle
    "mg_coarse_redundant_pc_factor_mat_ordering_type": "qmd",  # least fill of those that all PETSc have
    "mg_coarse_redundant_pc_factor_zeropivot": "1e-300",  # PETSc's is absolute, and a light body's pivots are small
}
NEWTON = {
    "snes_max_it": MANY,
    **JACOBI_CG,
    "ksp_rtol": "3e-2",
    **LATTICE_MULTIGRID,
}

PRESETS = {
    "anderson": Preset(
        "Anderson-accelerated local/global iterations with loose CG solves: easy steps to few digits, no Hessian",
        {
            "snes_type": "anderson",
            "snes_anderson_m": "5",
            "snes_npc_side": "left",
            "snes_max_it": "300",
            "npc_snes_type": "newtonls",  # a plain iteration, which preconditions the SNES
            "npc_snes_linesearch_type": "basic",
            "npc_snes_max_it": "1",
            "npc_snes_norm_schedule": "none",
            "npc_snes_divergence_tolerance": "-1",  # an impact may begin with 1e4 |F(y)|
            **JACOBI_CG,
            "ksp_rtol": "1e-1",
        },
    ),
    "lbfgs": Preset(
        "Liu et al. 2017: L-BFGS with A as the first Hessian and a line search: between anderson and newton",
        {
            "snes_type": "qn",
            "snes_qn_type": "lbfgs",
            "snes_qn_scale_type": "jacobian",
            "snes_qn_restart_type": "none",
            "snes_qn_m": "5",
            "snes_linesearch_type": "bt",
            "snes_max_it": "300",
            **NO_STOP_BY_SIZE,
            **JACOBI_CG,
            "ksp_rtol": "1e-1",
        },
    ),
    "newton": Preset(
        "Newton's method with the true Hessian and a line search: the default, fastest to nearly any error",
        NEWTON,
        true_hessian=True,
        chooses=True,
    ),
    "newton-multigrid": Preset(
        "The same with multigrid on the lattice, what newton itself takes for all others",
        {**NEWTON, "pc_type": "mg"},
        true_hessian=True,
    ),
    "newton-projected": Preset(
        "Newton's method, for long without the Hessian's negative parts: slower, and what a hard step falls back on",
        NEWTON,
        true_hessian=True,
        projected=100,
        chooses=True,
    ),
    "fast-msm": Preset(
        "Liu et al. 2013: local/global iterations, ten if no error is given, each a solve with a prefactored Cholesky",
        {**PLAIN, **CHOLESKY},
        iterations=10,
    ),
    "paper": Preset(
        "Zheng et al.: the same iterations with plain CG from x = b to a fixed tolerance",
        {
            **PLAIN,
            "ksp_type": "cg",
            "pc_type": "none",
            "ksp_norm_type": "unpreconditioned",
            "ksp_rtol": "1e-10",  # of |b|, as Algorithm 1 has it: 1e-6 left the step 17% off on a swinging beam
            "ksp_converged_use_initial_residual_norm": "",
        },
        start_from_b=True,
        iterations=10,
    ),
}


# a user who chooses another type does not want what only goes with ours
BOUND_TO_TYPE = {"pc_type": "pc_factor_mat_solver_type", "ksp_type": "ksp_norm_type"}
# these solve with A or the Hessian themselves, without a plain iteration as their preconditioner
SOLVE_THEMSELVES = {"newtonls", "newtontr", "ksponly", "vinewtonrsls", "vinewtonssls"}


in_use: Counter[str] = (
    Counter()
)  # by how many solvers: the options in PETSc's database that are not the user's


def preset_names() -> list[str]:
    """Return the names of all presets, those that were registered or installed last."""
    return [*PRESETS, *ADDED.names()]


def find_preset(name: str) -> Preset:
    """Return the preset of a name. Raises InputError with the nearest name for an unknown one."""
    if name in PRESETS:
        return PRESETS[name]
    if name not in ADDED.names():
        raise InputError(
            f"solver.preset: unknown preset {name!r}{did_you_mean(name, preset_names())}"
        )
    added = ADDED.find(name)  # {"options": ..., "based_on": ..., "about": ...}
    try:
        base = PRESETS[added.get("based_on", "newton")]
        words = options_of(words_of(added["options"]))
        return replace(base, about=str(added.get("about", "")), options=base.options | words)
    except (KeyError, TypeError, AttributeError):
        raise InputError(
            f'the preset {name!r} is no table of "options", "based_on" (one of {", ".join(PRESETS)}) and "about"'
        ) from None


def shown_options(solvers: dict[str, tuple[Preset, int]]) -> list[str]:
    """Options that PETSc's database holds for solvers, the user's own options among it, as lines of an options file.

    solvers : prefix of their options -> preset and budget of iterations

    A tolerance that is held to what a step needs stands in a comment: given, it would be held to as it is.
    """
    ours = [SolverOptions(preset, prefix, budget) for prefix, (preset, budget) in solvers.items()]
    adapting = {
        f"{each.prefix}ksp_rtol"
        for each in ours
        if each.preset.iterations is None and each.is_default("ksp_rtol")
    }
    lines = []
    for name, value in sorted(PETSc.Options().getAll().items()):
        quoted = f'"{value}"' if value and " " in value else value or ""
        line = f"-{name} {quoted}".rstrip()
        if name in adapting:
            line = f"# {line}    the tightest that a step may need; given, it is the one"
        lines.append(line)
    for each in ours:
        each.withdraw()
    return lines


class SolverOptions:
    """A preset's options in PETSc's database while its solver lives, where the user has set none.

    SNES then does not give up before the ``budget`` of iterations is spent.

    prefix : of the solver's options
    names  : of those that are the preset's own, prefix included
    """

    def __init__(self, preset: Preset, prefix: str, budget: int):
        self.preset, self.prefix = preset, prefix
        options = preset.options | {
            "snes_max_it": str(max(int(preset.options["snes_max_it"]), budget))
        }
        database = PETSc.Options()
        given = [name for name in database.getAll() if name.startswith(prefix) and not in_use[name]]
        users = {name.removeprefix(prefix) for name in given}
        bound = {BOUND_TO_TYPE[name] for name in BOUND_TO_TYPE.keys() & users}
        ours = options.keys() - users - bound
        if database.getString(f"{prefix}snes_type", "") in SOLVE_THEMSELVES:
            ours -= {name for name in ours if name.startswith("npc_")} | {"snes_npc_side"}
        for name in ours:
            database.setValue(prefix + name, options[name] or None)
        self.names = {prefix + name for name in ours}
        in_use.update(self.names)

    def is_default(self, name: str) -> bool:
        """Whether an option is the preset's own, not the user's."""
        return self.prefix + name in self.names

    def is_given(self, name: str) -> bool:
        """Whether an option stands in the database, the user's or the preset's."""
        return self.prefix + name in PETSc.Options().getAll()

    def value(self, name: str) -> str:
        """Value of an option, the user's or the preset's; "" where there is none."""
        return str(PETSc.Options().getString(self.prefix + name, ""))

    def withdraw(self) -> None:
        """Leave the database as the user has it, for other presets and -options_left."""
        in_use.subtract(self.names)
        for name in self.names:
            if not in_use[name]:
                PETSc.Options().delValue(name)
