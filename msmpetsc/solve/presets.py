"""Presets: each method is a set of PETSc options for the SNES of solve.nonlinear.step.

A user's option overrides the preset's option of the same name. Newton's method with the constant
matrix A is the paper's local/global iteration x <- x - A^(-1) F(x) (Eq. 17). The options -ksp_ and
-pc_ without a prefix control the linear solve, with A or with the true Hessian.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

from petsc4py import PETSc

from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.extensions import PRESETS as ADDED
from msmpetsc.solve.petsc.words import options_of, words_of


@dataclass(frozen=True)
class Preset:
    """Method given as a set of PETSc options.

    about        : when to use the method
    options      : PETSc options without the dash
    true_hessian : whether the Jacobian is the true Hessian of g instead of the constant A
    projected    : iterations with the projected Hessian at the start of each minimisation
    start_from_b : whether CG starts from x = b, as in the paper's Algorithm 1
    iterations   : fixed number of iterations from y, as the method was published. None: iterate to
        the error target from the best of several guesses; linear solves near the end of a step
        may then go beyond ksp_rtol
    """

    about: str
    options: dict[str, str]
    true_hessian: bool = False
    projected: int = 0
    start_from_b: bool = False
    iterations: int | None = None


# greatest number of iterations in a step, with all of CG, and greatest value of
# an option that is a count; so that every step ends
MOST_ITERATIONS = 100_000
CHOLESKY = {"ksp_type": "preonly", "pc_type": "cholesky", "pc_factor_mat_solver_type": "mumps"}
CG = {"ksp_type": "cg", "ksp_norm_type": "natural"}
JACOBI_CG = {**CG, "pc_type": "jacobi"}
# no stop by the length of a correction; the error alone ends a step or a line search
NO_STOP_BY_SIZE = {"snes_stol": "0"}
LOCAL_GLOBAL = {
    "snes_type": "newtonls",
    "snes_linesearch_type": "basic",
    "snes_max_it": "1000",
    **NO_STOP_BY_SIZE,
}
# greatest number of Newton iterations; a hard step needs hundreds (test_recovery.py)
NEWTON_ITERATIONS = "3000"
# options of the cycle of -pc_type mg
LATTICE_MULTIGRID = {
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_ksp_max_it": "1",
    "mg_coarse_ksp_type": "preonly",
    "mg_coarse_pc_type": "redundant",
    "mg_coarse_redundant_pc_type": "lu",
}
# options of Newton's method; nonlinear.jacobian chooses pc_type
NEWTON = {
    "snes_max_it": NEWTON_ITERATIONS,
    **CG,
    "ksp_rtol": "3e-2",
    **LATTICE_MULTIGRID,
}

PRESETS = {
    "anderson": Preset(
        "Anderson-accelerated local/global iterations with loose CG solves: easy steps to few "
        "digits, no Hessian",
        {
            "snes_type": "anderson",
            "snes_anderson_m": "5",
            "snes_npc_side": "left",
            "snes_max_it": "300",
            # A plain local/global iteration preconditions the SNES.
            "npc_snes_type": "newtonls",
            "npc_snes_linesearch_type": "basic",
            "npc_snes_max_it": "1",
            "npc_snes_norm_schedule": "none",
            # An impact may raise |F| far above |F(y)|.
            "npc_snes_divergence_tolerance": "-1",
            **JACOBI_CG,
            "ksp_rtol": "1e-1",
        },
    ),
    "lbfgs": Preset(
        "Liu et al. 2017: L-BFGS with A as the first Hessian and a line search: between anderson "
        "and newton",
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
        "Newton's method with the true Hessian and a line search: the default, fastest to nearly "
        "any error",
        NEWTON,
        true_hessian=True,
    ),
    "newton-multigrid": Preset(
        "Newton's method, always preconditioned by multigrid on the lattice: newton chooses it "
        "for all but short steps",
        {**NEWTON, "pc_type": "mg"},
        true_hessian=True,
    ),
    "newton-projected": Preset(
        "Newton's method with the projected Hessian for its first iterations: slower, the "
        "fallback of a hard step",
        NEWTON,
        true_hessian=True,
        projected=100,
    ),
    "fast-msm": Preset(
        "Liu et al. 2013: local/global iterations, ten if no error is given, each a solve with a "
        "prefactored Cholesky",
        {**LOCAL_GLOBAL, **CHOLESKY},
        iterations=10,
    ),
    "paper": Preset(
        "Zheng et al.: the same iterations with plain CG from x = b to a fixed tolerance",
        {
            **LOCAL_GLOBAL,
            "ksp_type": "cg",
            "pc_type": "none",
            "ksp_norm_type": "unpreconditioned",
            # Relative to |b|, as in Algorithm 1; 1e-6 leaves a large step error.
            "ksp_rtol": "1e-10",
            "ksp_converged_use_initial_residual_norm": "",
        },
        start_from_b=True,
        iterations=10,
    ),
}


# type option -> option that fits only the preset's type; another type drops it
BOUND_TO_TYPE = {"pc_type": "pc_factor_mat_solver_type", "ksp_type": "ksp_norm_type"}
# SNES types that solve with the Jacobian and take no nonlinear preconditioner
SOLVE_THEMSELVES = {"newtonls", "newtontr", "ksponly", "vinewtonrsls", "vinewtonssls"}

# option of a preset in PETSc's database -> number of solvers that use the option
in_use: Counter[str] = Counter()


def preset_names() -> list[str]:
    """Return the names of all presets: built-in presets first, then registered or installed."""
    return [*PRESETS, *ADDED.names()]


def find_preset(name: str) -> Preset:
    """Return the preset of a name. Raises InputError, with the nearest name, if it is unknown."""
    if name in PRESETS:
        return PRESETS[name]
    if name not in ADDED.names():
        raise InputError(
            f"solver.preset: unknown preset {name!r}{did_you_mean(name, preset_names())}"
        )
    # An added preset is {"options": ..., "based_on": ..., "about": ...}.
    added = ADDED.find(name)
    try:
        base = PRESETS[added.get("based_on", "newton")]
        words = options_of(words_of(added["options"]))
        kept = {key: base.options[key] for key in base.options.keys() - unfit(base.options, words)}
        return replace(base, about=str(added.get("about", "")), options=kept | words)
    except (KeyError, TypeError, AttributeError):
        raise InputError(
            f'the preset {name!r} is no table of "options", "based_on" '
            f'(one of {", ".join(PRESETS)}) and "about"'
        ) from None


def unfit(options: Mapping[str, str], given: Mapping[str, str]) -> set[str]:
    """Return the names of options that fit only the type that given options replace."""
    return {
        bound
        for name, bound in BOUND_TO_TYPE.items()
        if given.get(name, options.get(name)) != options.get(name)
    }


def shown_options(solvers: dict[str, tuple[Preset, int]]) -> list[str]:
    """Return the options of solvers, the user's options included, as lines of an options file.

    An adaptive tolerance stands in a comment, because a tolerance in the file would be fixed.

    solvers : prefix of the solver's options -> preset and budget of iterations
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
            line = f"# {line}    solves near the end of a step go beyond it; fixed if given"
        lines.append(line)
    for each in ours:
        each.withdraw()
    return lines


class SolverOptions:
    """Keep a preset's options in PETSc's database while its solver exists; users' options win.

    The options let SNES run until the ``budget`` of iterations is spent.

    prefix : prefix of the solver's options
    names  : names, with the prefix, of the options that come from the preset
    """

    def __init__(self, preset: Preset, prefix: str, budget: int):
        self.preset, self.prefix = preset, prefix
        options = preset.options | {
            "snes_max_it": str(max(int(preset.options["snes_max_it"]), budget))
        }
        database = PETSc.Options()
        users = {
            name.removeprefix(prefix): value
            for name, value in database.getAll().items()
            if name.startswith(prefix) and not in_use[name]
        }
        ours = options.keys() - users.keys() - unfit(options, users)
        if database.getString(f"{prefix}snes_type", "") in SOLVE_THEMSELVES:
            ours -= {name for name in ours if name.startswith("npc_")} | {"snes_npc_side"}
        for name in ours:
            database.setValue(prefix + name, options[name] or None)
        self.names = {prefix + name for name in ours}
        in_use.update(self.names)

    def is_default(self, name: str) -> bool:
        """Return whether an option comes from the preset, not from the user."""
        return self.prefix + name in self.names

    def is_given(self, name: str) -> bool:
        """Return whether the user or the preset sets an option."""
        return self.prefix + name in PETSc.Options().getAll()

    def value(self, name: str) -> str:
        """Return the value of an option; "" if neither the user nor the preset sets it."""
        return str(PETSc.Options().getString(self.prefix + name, ""))

    def withdraw(self) -> None:
        """Remove the preset's options from the database, for other presets and -options_left."""
        in_use.subtract(self.names)
        for name in self.names:
            if not in_use[name]:
                PETSc.Options().delValue(name)
