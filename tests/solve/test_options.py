"""PETSc's options are obeyed, or refused in a line before anything is built."""

import re
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from block_scene import GRAVITY, block_scene
from conftest import ENVIRONMENT, python, run
from lattices import beam, swing, weight
from mpi4py import MPI
from one_process import NOISE, assert_one_line, command_error, input_error
from petsc4py import PETSc

from msmpetsc.app.ranks import ALONE
from msmpetsc.cli.command_table import COMMANDS
from msmpetsc.cli.main import option_names
from msmpetsc.errors import InputError, StepFailed
from msmpetsc.solve.nonlinear import method
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.petsc.initialise import _check_words
from msmpetsc.solve.presets import PRESETS, find_preset, shown_options
from msmpetsc.solve.refused_options import refuse_early, refuse_unused

T = 1 / 60
COMM = MPI.COMM_SELF
# a scene in motion
SCENE = {
    "time": {"step": 0.01, "duration": 0.02},
    "gravity": GRAVITY,
    "pin": [{"region": {"box": [[-1, -1, 0.9], [2, 2, 2]], "relative": True}}],
}
COMMAND = ("-m", "msmpetsc.cli.main", "run")


# Refused before anything is built

NO_USE = {
    "snes_rtol": ("1e-3", "solver.error"),
    "fallback_snes_stol": ("1", "solver.error"),
    "snes_lag_jacobian": ("2", "solver.preset"),
    "snes_mf": ("", "solver.preset"),
    "snes_type": ("newtontr", "newtonls"),
    "fallback_snes_type": ("ksponly", "newtonls"),
    "ksp_max_it": ("0", "from 1 to"),
    "mg_levels_ksp_max_it": ("-1", "from 1 to"),
    "snes_max_it": ("1000000000", "from 1 to"),
    "ksp_rtol": ("0", "above 0"),
    "fallback_ksp_rtol": ("", "needs a number"),
    "mg_coarse_ksp_rtol": ("inf", "below 1"),
    "snes_linesearch_damping": ("NaN", "not a number"),
    "mg_levels_ksp_chebyshev_eigenvalues": ("1,nan", "not a number"),
    "mg_levels_1_pc_python_type": ("abc", "Python"),
    "mg_coarse_ksp_type": ("pipelcg", "does not end"),
    "ksp_type": ("fetidp", "bddc"),
    "three_columns_pc_type": ("bjacobi", "-pc_"),
    "mg_coarse_ksp_error_if_not_converged": ("", "status 3"),
    "ksp_monitor": ("binary:f.dat", "ascii:FILE"),
    "mat_view": ("binary:A.dat", "not written"),
    "ksp_view_pmat": ("binary:A.dat", "not written"),
}


@pytest.mark.parametrize("name", NO_USE)
def test_what_cannot_be_of_use_is_one_line_that_says_what_is(petsc_options, name: str):
    value, word = NO_USE[name]
    petsc_options(**{name: value})
    text = input_error(lambda: refuse_early(COMM))
    assert text.startswith(f"-{name}") and word in text


@pytest.mark.parametrize("name", ["ksp_tpye", "ksp_vieww", "mg_levels_ksp_typ"])
def test_a_misspelt_option_is_told_with_the_nearest(petsc_options, name: str):
    petsc_options(**{name: "cg"})
    refuse_early(COMM)
    with pytest.raises(
        InputError, match=f"-{name}: no part of this run.*, did you mean '{name[:5]}"
    ):
        refuse_unused(COMM, at_end=True)


# PETSc can read the value
LINES = dict.fromkeys(("-ksp_type cg", "", '-log_view "a b"', "-shift -0.5", "alias -a -b"), True)
LINES |= dict.fromkeys(
    ("ksp_type cg", "-ksp_type cg -pc_type none", "-ksp_type cg jacobi", "-fp_trap"), False
)


@pytest.mark.parametrize("line", LINES)
def test_an_options_file_is_looked_through_first(tmp_path: Path, line: str):
    """Only rank 0 reads the file; without this check the other ranks would wait for ever."""
    file = tmp_path / "options"
    file.write_text(f"-pc_type jacobi\n{line}\n")
    with nullcontext() if LINES[line] else pytest.raises(InputError, match="line 2"):
        _check_words(["-options_file", str(file)])


@pytest.mark.parametrize(
    "words", [["-options_file"], ["-options_file", "-ksp_view"], ["-options_file", "/dev/null"]]
)
def test_an_options_file_is_a_file(words: list[str]):
    with pytest.raises(InputError, match="-options_file"):
        _check_words(words)


def test_the_file_of_a_view_lies_in_a_folder(tmp_path: Path):
    _check_words(["-log_view", f":{tmp_path}/log:ascii_xml,:beside", "-ksp_view", "-log_view"])
    with pytest.raises(InputError, match=r"-log_view: no folder .*/gone"):
        _check_words(["-log_view", f":{tmp_path}/log,:{tmp_path}/gone/log"])


BEFORE_THE_MESH = {
    "-snes_rtol 1e-3": "solver.error",
    "-options_file gone": "gone",
    "-malloc_debug abc": "abc",
    "-python": "-python",
    "-fp_trap": "not finite",
}
MULTIGRID = "--preset newton-multigrid --set cages.cell_size=0.0625 "
WITH_THE_SOLVERS = {
    "-ts_dt 1": "-ts_dt",
    "-ksp_rtol abc": "abc",
    "-snes_type nonsense": "loop and a line search of their own",
    "-pc_type nonsense": "nonsense",
    # the dense block in use could not be destroyed
    "-pc_type composite": "composite",
    # the search for the lowest mode at rest applies this preconditioner
    "--set time.integrator=static -pc_type composite": "composite",
    "--set time.integrator=static -pc_type shell": "apply",
    "--set time.integrator=verlet -ksp_type cg": "-ksp_type",
    "--preset anderson -pc_type mg": "newton's presets",
    MULTIGRID + "-pc_mg_levels 1": "nearest for this lattice is 2",
    MULTIGRID + "-pc_mg_levels 9": "nearest for this lattice is",
    MULTIGRID + "-pc_mg_galerkin both": "PETSc cannot set up the solver",
    MULTIGRID + "-mg_levels_pc_type nonsense": "nonsense",
    MULTIGRID + "-mg_levels_1_pc_type redistribute": "finest level",
}
# options of multigrid's cycle that go together, and words of their effect
OBEYED = {
    "-pc_mg_levels 2 -mg_levels_ksp_max_it 2 -mg_coarse_pc_type lu "
    "-ksp_view": "MULTIPLICATIVE, levels=2",
    "-pc_mg_levels 3 -pc_mg_cycle_type w -matptap_via scalable -pc_mg_log "
    "-log_view": "MGSmooth Level 1",
    "-pc_mg_type additive -mg_coarse_redundant_pc_type lu": "",
    "-pc_mg_type full -mg_levels_ksp_type richardson": "",
}


@pytest.mark.parametrize(
    ("ranks", "options"),
    [*((1, options) for options in BEFORE_THE_MESH), (2, "-options_file gone")],
)
def test_it_is_told_before_the_mesh_is_read(tmp_path: Path, ranks: int, options: str):
    """The error comes before the mesh is read: the mesh is missing."""
    scene = block_scene(tmp_path, **SCENE, mesh={"source": "gone.ply"})
    before = sorted(tmp_path.iterdir())
    done = run(ranks, *COMMAND, scene, "-o", tmp_path / "o.h5", *options.split())
    assert_one_line(done, 2, BEFORE_THE_MESH[options])
    assert "gone.ply" not in done.stderr
    assert sorted(tmp_path.iterdir()) == before


def test_an_option_of_ours_with_one_dash_is_told_its_name():
    options = [
        (name, option)
        for name in COMMANDS
        for option in option_names(name)
        if option.startswith("--")
    ]
    assert len(options) > 40
    for name, option in set(options) - {("run", "--help"), ("inspect", "--help")}:
        assert f"did you mean '{option}'?" in command_error(name, option[1:], "3")
    assert "takes no PETSc options" in command_error("compare", "a.h5", "b.h5", "-ksp_type", "cg")


@pytest.mark.parametrize("ranks", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("options", WITH_THE_SOLVERS)
def test_an_error_within_petsc_is_one_line_and_no_crash_when_the_process_ends(
    tmp_path: Path, options: str, ranks: int
):
    scene = block_scene(tmp_path, **SCENE)
    done = run(ranks, *COMMAND, scene, "-o", tmp_path / "o.h5", *options.split())
    assert_one_line(done, 2, WITH_THE_SOLVERS[options])


@pytest.mark.slow
@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize("options", OBEYED)
def test_options_of_the_cycle_are_obeyed(tmp_path: Path, options: str, ranks: int):
    scene, words = block_scene(tmp_path, **SCENE), (MULTIGRID + options).split()
    done = run(ranks, *COMMAND, scene, "-o", tmp_path / "o.h5", *words, status=0)
    assert OBEYED[options] in done.stdout
    assert not any(noise in done.stdout + done.stderr for noise in NOISE)


# collects garbage as often as Python can
COLLECTING = """
import gc, sys
from msmpetsc.cli.main import main
gc.set_threshold(1)
sys.exit(main(sys.argv[1:]))
"""


def test_an_error_within_petsc_survives_a_collection_of_garbage(tmp_path: Path):
    """Since Python 3.12 a collection in petsc4py's error handler discards the exception."""
    options = "-pc_type composite"
    scene = block_scene(tmp_path, **SCENE)
    done = run(1, "-c", COLLECTING, "run", scene, "-o", tmp_path / "o.h5", *options.split())
    assert_one_line(done, 2, WITH_THE_SOLVERS[options])


FRAMES = "import sys, msmpetsc; list(msmpetsc.frames(sys.argv[1], petsc_options=sys.argv[2]))"


@pytest.mark.parametrize("options", ["-pc_type jacobbi", "-pc_type hypre -pc_hypre_type foo"])
def test_a_process_ends_with_its_error_though_python_has_left_petsc_an_object(
    tmp_path: Path, options: str
):
    """The traceback holds a PC of type python, which PETSc destroyed after Python had ended."""
    scene = block_scene(tmp_path, **SCENE)
    words = [*COMMAND, scene, "-o", tmp_path / "o.h5", *options.split()]
    done = python(*words, env=ENVIRONMENT | ALONE)
    assert_one_line(done, 2, "PETSc")
    done = python("-c", FRAMES, scene, options, env=ENVIRONMENT | ALONE)
    assert done.returncode == 1 and "PETSC ERROR" not in done.stderr, done.stderr
    assert done.stderr.splitlines()[-1].startswith("msmpetsc.errors.InputError: PETSc")


def test_an_option_that_no_object_has_is_told_before_the_last_frame(tmp_path: Path):
    scene = block_scene(tmp_path, **SCENE | {"time": {"step": 0.01, "duration": 1.0}})
    done = run(1, *COMMAND, scene, "-o", tmp_path / "o.h5", "-ts_monitor")
    assert_one_line(done, 2, "-ts_monitor")
    assert "frame 1/100" not in done.stderr


def test_an_option_that_is_read_while_solving_is_awaited_until_something_is_solved(tmp_path: Path):
    """A body at rest without loads solves nothing, so the option stays unread without an error."""
    still = SCENE | {"gravity": {"acceleration": [0, 0, 0]}}
    run(1, *COMMAND, block_scene(tmp_path, **still), "-o", tmp_path / "o.h5", "-ksp_view", status=0)
    done = run(
        1, *COMMAND, block_scene(tmp_path, **SCENE), "-o", tmp_path / "p.h5", "-ksp_view", status=0
    )
    assert "KSP Object" in done.stdout


@pytest.mark.parametrize("option", ["snes_type", "snes_linesearch_type", "snes_ksp_ew"])
def test_newton_refuses_options_of_the_loop_that_it_has_itself(petsc_options, option: str):
    petsc_options(**{option: "basic"})
    with pytest.raises(InputError, match=f"-{option}: newton's presets have a loop"):
        Stepper(COMM, beam(), T, find_preset("newton"), 1e-9)


def test_newtons_loop_keeps_what_options_of_snes_mean(tmp_path: Path):
    path = block_scene(
        tmp_path, **SCENE | {"solver": {"preset": "newton-multigrid", "error": 1e-4}}
    )
    words = ["-snes_monitor", "-snes_converged_reason", "-snes_view", "-ksp_view"]
    said = run(1, *COMMAND, path, "-o", tmp_path / "o.h5", *words, status=0).stdout
    iterations = [int(number) for number in re.findall(r"(\d+) SNES Function norm", said)]
    ends = [int(number) for number in re.findall(r"due to CONVERGED_\w+ iterations (\d+)", said)]
    assert len(ends) > 1 and ends[-1] > 0 and len(iterations) == sum(ends) + len(ends)
    assert "Newton" in said and "maximum iterations=3000" in said and "operator complexity" in said


def test_a_solver_that_ends_by_a_rule_of_its_own_is_told(petsc_options):
    petsc_options(snes_type="ksponly", pc_type="jacobi")
    lattice = beam()
    stepper = Stepper(COMM, lattice, T, find_preset("anderson"), 1e-9)
    problem = StepProblem(lattice.nodes, lattice.nodes, weight(lattice))
    with pytest.raises(InputError, match="ksponly ends by a rule of its own"):
        stepper.step(problem)
    stepper.destroy()


def test_iterations_of_a_step_have_a_bound_that_no_option_lifts(
    petsc_options, monkeypatch: pytest.MonkeyPatch
):
    """Steps so short that they make no progress go on up to the bound."""
    monkeypatch.setattr(method, "MOST_ITERATIONS", 2000)
    petsc_options(
        snes_type="newtonls", snes_linesearch_maxstep="1e-9", snes_max_it="9000", pc_type="jacobi"
    )
    lattice = beam()
    stepper = Stepper(COMM, lattice, T, find_preset("anderson"), 1e-9)
    problem = StepProblem(lattice.nodes, lattice.nodes, weight(lattice))
    with pytest.raises(StepFailed, match="DIVERGED_MAX_IT"):
        stepper.step(problem)
    assert 2000 < stepper.work_so_far().ksp_its + stepper.method.iterations < 2100
    stepper.destroy()


@pytest.mark.parametrize("load", ["gravity", "force"])
def test_a_load_beyond_all_numbers_is_told(tmp_path: Path, load: str):
    force = {"region": {"box": [[0, 0, 0], [1, 1, 0.1]], "relative": True}, "total": [1e30, 0, 0]}
    tables = (
        {"gravity": {"acceleration": [1e30, 0, 0]}} if load == "gravity" else {"force": [force]}
    )
    path = block_scene(tmp_path, **SCENE | tables)
    assert "check gravity, force" in command_error("run", path, "-o", tmp_path / "o.h5")
    # no lock
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("preset", ["newton", "anderson", "lbfgs"])
def test_the_reason_says_which_rule_ended_the_step(preset: str):
    """The rules are a short correction, a small |F|, and the budget."""
    reasons, seen = PETSc.SNES.ConvergedReason, set()
    lattice = beam()
    for error, budget in ((1e-1, None), (1e-2, None), (2e-2, None), (1e-3, None), (1e-12, 2)):
        stepper = Stepper(COMM, lattice, T, find_preset(preset), error, budget)
        stepper.step(StepProblem(lattice.nodes, lattice.nodes, weight(lattice)))
        reason = stepper.snes.reason
        stepper.destroy()
        by_error = {reasons.CONVERGED_SNORM_RELATIVE, reasons.CONVERGED_FNORM_RELATIVE}
        assert reason in ({reasons.CONVERGED_ITS} if budget else by_error)
        seen.add(reason)
    assert seen >= {reasons.CONVERGED_SNORM_RELATIVE, reasons.CONVERGED_ITS}


@pytest.mark.parametrize("preset", PRESETS)
def test_shown_options_given_back_change_nothing(petsc_options, preset: str):
    before = swing(preset, 2)
    lines = shown_options({"": (find_preset(preset), 0)})
    given = dict(
        line[1:].split() if " " in line else (line[1:], "")
        for line in lines
        if line.startswith("-")
    )
    assert {f"-{name} {value}".strip() for name, value in PRESETS[preset].options.items()} <= {
        line.removeprefix("# ").partition("    ")[0] for line in lines
    }
    petsc_options(**given)
    refuse_early(COMM)
    after = swing(preset, 2)
    np.testing.assert_array_equal(after[-1].position, before[-1].position)
    assert [result.cost.ksp_its for result in after] == [result.cost.ksp_its for result in before]


def test_options_are_shown_without_a_mesh_as_a_file_that_can_be_given(tmp_path: Path):
    shown = run(2, *COMMAND, "--show-options", "--preset", "anderson", "-ksp_max_it", "77")
    assert shown.returncode == 0, shown.stderr
    assert shown.stdout.splitlines().count("-snes_type anderson") == 1
    assert "-ksp_max_it 77" in shown.stdout and "# -ksp_rtol 1e-1" in shown.stdout
    (tmp_path / "options").write_text(shown.stdout)
    scene = block_scene(
        tmp_path,
        **SCENE,
        mesh={"source": "gone.ply"},
        solver={"preset": "paper", "max_iterations": 2000},
    )
    other = ("--show-options", scene, "--true-error", "1", "-pc_type", "sor")
    shown = run(1, *COMMAND, *other)
    assert "-reference_pc_type mg" in shown.stdout and "-snes_max_it 2000" in shown.stdout, (
        shown.stderr
    )
    assert "-pc_type sor" in shown.stdout and "-pc_type none" not in shown.stdout
    scene = block_scene(tmp_path, **SCENE)
    given = ("--preset", "anderson", "--frames", "1", "-options_file", tmp_path / "options")
    run(1, *COMMAND, scene, "-o", tmp_path / "o.h5", *given, status=0)


@pytest.mark.parametrize(
    ("option", "wanted"), [("ksp_type=pipcg", "pipecg"), ("pc_type=jacoby", "jacobi")]
)
def test_a_misspelt_type_of_solver_is_named_with_the_nearest(
    option: str, wanted: str, tmp_path: Path
):
    name, value = option.split("=")
    words = ["run", block_scene(tmp_path, **SCENE), "-o", tmp_path / "o.h5", f"-{name}", value]
    assert f"{value}, did you mean {wanted!r}?" in command_error(*words)


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_s_own_option_given_changes_nothing(petsc_options, preset: str):
    solvers = {"": (find_preset(preset), 0)}
    before = shown_options(solvers)
    for name in ("ksp_type", "pc_type"):
        if value := PRESETS[preset].options.get(name):
            petsc_options(**{name: value})
    assert shown_options(solvers) == before
