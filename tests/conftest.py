"""Fixtures and functions that several test files share: MPI runs, small bodies, durations."""

import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
from forked import run_forked, run_ranks

from msmpetsc.app.ranks import ALONE

ROOT = Path(__file__).parent.parent
# programs for mpiexec
WORKERS = ROOT / "tests" / "workers"
AS_ROOT = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
# for commands that start mpiexec within a test
os.environ.update(AS_ROOT)
# waiting ranks yield their core, since there are more ranks than cores
SHARED_CORES = {"OMPI_MCA_mpi_yield_when_idle": "1"}
# Open MPI 5 prints a line per rank about networks that do not pair, IPv4 with IPv6;
# ranks of one machine need none
ONE_MACHINE = {"OMPI_MCA_btl_tcp_if_include": "lo"}
# PATHS holds the path by which petsc4py may be found. The environment is that of this
# process at its start: a running MPI adds variables that would confuse a child.
PATHS = os.pathsep.join(
    filter(None, (str(ROOT), str(ROOT / "tests" / "helpers"), os.environ.get("PYTHONPATH")))
)
ENVIRONMENT = {
    **os.environ,
    **AS_ROOT,
    "PYTHONPATH": PATHS,
    "OMP_NUM_THREADS": "1",
    **SHARED_CORES,
    **ONE_MACHINE,
}

# Seconds that all tests of each file took together; scripts/test --record-durations
# writes them
DURATIONS = Path(__file__).parent / "durations.json"
# Seconds of a file up to which its tests are in the smoke run, which takes three
# minutes in all
SMOKE = 10.0

# time limit of a run [s]; a loaded machine is up to ten times as slow
HANGS = 500.0

Run = Callable[..., subprocess.CompletedProcess]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that records the durations of test files."""
    parser.addoption(
        "--record-durations", action="store_true", help=f"write {DURATIONS.name} after all tests"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Deselect slow tests unless tests are chosen by their file, by -m or by -k."""
    options = config.option
    if (
        config.args_source is not config.ArgsSource.ARGS
        and not options.markexpr
        and not options.keyword
    ):
        options.markexpr = "not slow"
    if options.record_durations and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Recorder())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first, and mark the tests of short files as smoke tests."""
    seconds = json.loads(DURATIONS.read_text())
    items.sort(key=lambda item: -seconds.get(file_of(item.nodeid), 0.0))
    for item in items:
        is_short = seconds.get(file_of(item.nodeid), np.inf) <= SMOKE
        if is_short and not item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.smoke)


def file_of(test: str) -> str:
    """Return the file of a test's id."""
    return test.partition("::")[0]


class Recorder:
    """Recorder of the seconds that each test file takes."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = json.loads(DURATIONS.read_text())
        self.run: Counter[str] = Counter()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add the seconds of a set-up, a test or a tear-down."""
        self.run[file_of(report.nodeid)] += report.duration

    def pytest_sessionfinish(self) -> None:
        """Write the seconds of all existing files; a file that was not run keeps its old value."""
        seconds = self.seconds | {file: round(took, 1) for file, took in self.run.items()}
        there = {file: seconds[file] for file in sorted(seconds) if Path(file).is_file()}
        lines = json.dumps(there, indent=0)
        DURATIONS.write_text(f"{lines}\n")


def run(ranks: int, *arguments: object, status: int | None = None) -> subprocess.CompletedProcess:
    """Run Python with these arguments on so many ranks of a real mpiexec; raise at the time limit.

    All ranks are forked from a process that has imported the package.

    status : the exit status that the run must have; None for any
    """
    words = [*map(str, arguments)]
    if ranks == 1 and words[:2] in (["-m", "msmpetsc.cli.main"], ["-m", "msmpetsc"]):
        done = run_forked(words[2:], ENVIRONMENT | ALONE, HANGS)
    else:
        done = run_ranks(ranks, words, ENVIRONMENT, HANGS)
    assert status in (None, done.returncode), done.stdout + done.stderr
    return done


def python(
    *words: object, env: Mapping[str, str] = ENVIRONMENT, **options: Any
) -> subprocess.CompletedProcess:
    """Run Python in a new process to its end; the time limit of the test ends a hang."""
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, env=env, capture_output=True, text=True, **options)


def result_on(ranks: int, scene: Path, *words: object) -> h5py.File:
    """Run a scene on so many ranks and return its result, which lies beside the scene."""
    path = scene.with_name(f"{scene.stem}_{ranks}.h5")
    run(ranks, "-m", "msmpetsc.cli.main", "run", scene, "-o", path, *words, status=0)
    return h5py.File(path)


@pytest.fixture
def msmpetsc() -> Run:
    """Return the function msmpetsc(2, "run", "scene.toml") that runs a command on two ranks."""
    return lambda ranks, *arguments, **options: run(
        ranks, "-m", "msmpetsc.cli.main", *arguments, **options
    )


@pytest.fixture(scope="session")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the PLY file of a ball of 320 triangles and diameter 2."""
    path = tmp_path_factory.mktemp("meshes") / "ball.ply"
    trimesh.creation.icosphere(subdivisions=2, radius=1).export(path)
    return path


@pytest.fixture(scope="session")
def falling_ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the result of a ball that falls and leaps, with its surface; do not change it."""
    # this import starts MPI
    from ball_result import write_ball

    return write_ball(tmp_path_factory.mktemp("falling") / "ball.h5")


@pytest.fixture(scope="session")
def bar_result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the result of a bar of two cells; do not change it."""
    import small_result

    return small_result.write(tmp_path_factory.mktemp("bar") / "bar.h5")


@pytest.fixture
def petsc_options():
    """Set PETSc options as a user would, and remove them after the test."""
    from petsc4py import PETSc

    database, names = PETSc.Options(), []

    def set_options(**options: str) -> None:
        for name, value in options.items():
            database.setValue(name, value)
            names.append(name)

    yield set_options
    for name in names:
        database.delValue(name)
