"""Each option that -help lists is tried with wrong types, zero, negative values and no numbers.

Each run is a fork of this process, which has run the scene before. A fork takes a fifth of a
second, a start two seconds.
"""

import os
import re
import resource
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from block_scene import GRAVITY, block_scene, plane_at
from conftest import HANGS, run
from mpi4py import MPI

from msmpetsc.cli.main import main
from msmpetsc.solve.petsc.initialise import finalise, start_for_runs

PINNED = [{"region": {"box": [[-1, -1, 0.9], [2, 2, 2]], "relative": True}}]
FLOOR = [plane_at(-0.001, response="penalty")]
MOVES = {"time": {"step": 0.01, "duration": 0.01}, "gravity": GRAVITY}
# tables of scenes, and options that make the objects
SCENES = {
    "multigrid": (
        MOVES | {"pin": PINNED, "solver": {"preset": "newton-multigrid", "error": 1e-6}},
        [],
    ),
    "contact": (
        MOVES | {"obstacle": FLOOR, "solver": {"preset": "newton", "error": 1e-4}},
        ["-pc_type", "gamg"],
    ),
    "anderson": (MOVES | {"pin": PINNED, "solver": {"preset": "anderson", "error": 1e-4}}, []),
    "static": (
        MOVES | {"time": {"integrator": "static"}, "pin": PINNED, "solver": {"preset": "newton"}},
        [],
    ),
}
# options that once ended in a crash, a traceback or a hang
FAULTY = [
    "-ksp_max_it 0", "-ksp_max_it -1", "-pc_mg_levels 0", "-pc_type shell", "-pc_type composite",
    "-pc_type jacobbi", "-pc_type hypre -pc_hypre_type foo", "-pc_type gamg -pc_gamg_type foo",
    "-ksp_rtol 0", "-ksp_rtol nan", "-snes_type ksponly", "-snes_type ms",
    "-snes_linesearch_damping nan", "-snes_linesearch_maxstep 1e-9", "-ksp_norm_type none",
    "-pc_type cp", "-pc_type kaczmarz", "-pc_type eisenstat", "-mg_levels_ksp_max_it 0",
    "-mg_levels_ksp_chebyshev_eigenvalues 1e9,1e10",
]  # fmt: skip
# the machine may have no display
OF_OBJECTS = re.compile(r"(?!\w*(plot|_lg))\w*?(snes|ksp|pc|mat|mg|sub|npc)_")
VIEWER = re.compile(r" (ascii|binary|draw|socket|saws)\[?:")
CHOICES = re.compile(r"\((?:choose )?one of\)?(.*?)\(\w*\)?$")
NOT_WORDS = ["abc", "0", "-1", "nan"]
# limit of CPU time [s]; a case takes a fifth of a second
SECONDS = 60
SIGNALS = (signal.SIGSEGV, signal.SIGABRT, signal.SIGFPE, signal.SIGBUS, signal.SIGILL)


def options_in(text: str) -> Iterator[tuple[str, str]]:
    """Yield the options that PETSc's help lists, each with the values to try."""
    seen = set()
    for name, rest in re.findall(r"^ +-(\w+)(:? .*)$", text, re.MULTILINE):
        if name in seen or VIEWER.match(rest) or not OF_OBJECTS.match(name):
            continue
        seen.add(name)
        choices = CHOICES.search(rest)
        for value in ["foo", *choices[1].split()] if choices else NOT_WORDS:
            yield f"-{name}", value


def attempt(folder: Path, words: list[str]) -> tuple[int | None, str]:
    """Return the status and all output of a command in a fork.

    The status is negative for a signal, None for a hang.
    """
    path = folder / "said"
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
            # PETSc's handlers would wait for MPI, which this process has not started
            for number in SIGNALS:
                signal.signal(number, signal.SIG_DFL)
            said = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            for stream in (1, 2):
                os.dup2(said, stream)
            sys.stdout, sys.stderr = (os.fdopen(stream, "w", closefd=False) for stream in (1, 2))
            status = main(words)
            finalise()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    end = time.monotonic() + HANGS
    while time.monotonic() < end:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status), path.read_text(errors="replace")
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None, path.read_text(errors="replace")


def fault_of(status: int | None, said: str) -> str:
    """Return why a user should not see this end; an empty string for a good end."""
    errors = [line for line in said.splitlines() if line.startswith("msmpetsc: error:")]
    if status not in (0, 2, 3) or len(errors) != (status != 0):
        return f"status {status}, {len(errors)} lines of error"
    return next((noise for noise in ("Traceback", "PETSC ERROR", "MPI_ABORT") if noise in said), "")


def faults_of(folder: Path, words: list[str], options: list[list[str]]) -> str:
    """Return a paragraph for each of a command's options that ends as no user should see it."""
    start_for_runs(MPI.COMM_WORLD, [])
    assert main(words) == 0
    ends = [(option, *attempt(folder, [*words, *option])) for option in options]
    return "\n".join(
        f"{' '.join(option)}: {fault}\n{said[-400:]}"
        for option, status, said in ends
        if (fault := fault_of(status, said))
    )


def command(folder: Path, name: str) -> list[str]:
    """Return the words that run one of the scenes."""
    tables, objects = SCENES[name]
    words = ["run", block_scene(folder, **tables), "-o", folder / "o.h5", "--overwrite", *objects]
    return [str(word) for word in words]


@pytest.mark.parametrize(
    ("name", "every"),
    [("multigrid", 160), *(pytest.param(name, 7, marks=pytest.mark.slow) for name in SCENES)],
)
def test_each_option_is_obeyed_or_refused_in_one_line(tmp_path: Path, name: str, every: int):
    words = command(tmp_path, name)
    tried = list(options_in(run(1, "-m", "msmpetsc", *words, "-help", status=0).stdout))
    assert len(tried) > 300
    faults = faults_of(tmp_path, words, [list(option) for option in tried[::every]])
    assert not faults, faults


@pytest.mark.parametrize(
    "name",
    ["multigrid", *(pytest.param(x, marks=pytest.mark.slow) for x in SCENES if x != "multigrid")],
)
def test_an_option_that_was_at_fault_is_obeyed_or_refused_in_one_line(tmp_path: Path, name: str):
    faults = faults_of(tmp_path, command(tmp_path, name), [options.split() for options in FAULTY])
    assert not faults, faults
