"""Compiled kernels are found again in any writable folder, but only by the same sources."""

import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import ENVIRONMENT, python

import msmpetsc
from msmpetsc.backend import kernel_cache

PACKAGE = Path(msmpetsc.__file__).parent
FILES = resource.RLIMIT_FSIZE
# not even root can make this folder
NOWHERE = "/dev/null/home"
PLAIN = (
    "from typing import NamedTuple\nFACTOR = 2.0\nclass Pair(NamedTuple):\n    first: float\n"
    "    second: float\n"
)
CALLED = "from msmpetsc.backend.kernel import njit\n@njit()\ndef called(x):\n    return x + 1.0\n"
CALLER = """
from msmpetsc.backend.called import called
from msmpetsc.backend.kernel import njit
from msmpetsc.backend.plain import FACTOR, Pair
@njit()
def caller(pair):
    return FACTOR * called(pair.first)
print(caller(Pair(first=3.0, second=5.0)), sum(caller.stats.cache_hits.values()))
"""


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """Return a copy of the package with a kernel of its own, in a folder that stores no kernels."""
    package = tmp_path / "copy" / "msmpetsc"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__", "shipped"))
    (package / "__pycache__").touch()
    for name, text in (("plain", PLAIN), ("called", CALLED), ("caller", CALLER)):
        (package / "backend" / f"{name}.py").write_text(text)
    return package


@pytest.fixture
def chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return the folder of kernels within the folder that the user has chosen."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernel_cache.folders.cache_clear()
    folder = kernel_cache.writable()
    assert folder is not None and folder.parent == tmp_path
    yield folder
    kernel_cache.folders.cache_clear()


def environment(package: Path, **variables: object) -> dict[str, str]:
    """Return environment variables that allow kernels only in the given folders."""
    given = {"HOME": NOWHERE, "PYTHONPATH": str(package.parent), **variables}
    others = {
        name: x
        for name, x in ENVIRONMENT.items()
        if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
    }
    return others | {name: str(x) for name, x in given.items()}


def called(package: Path, **variables: object) -> tuple[float, int]:
    """Return the value of the kernel in a new process, and the number of kernels found compiled."""
    # Python takes a source changed within a second, of the same size, for unchanged
    variables["PYTHONDONTWRITEBYTECODE"] = 1
    done = python(package / "backend" / "caller.py", env=environment(package, **variables))
    assert done.returncode == 0 and not done.stderr, done.stderr
    value, found = done.stdout.split()
    return float(value), int(found)


@pytest.mark.parametrize("name", ["NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME"])
def test_kernels_are_found_again_wherever_they_can_be_kept(copied: Path, tmp_path: Path, name: str):
    (tmp_path / "here").mkdir()
    assert [called(copied, **{name: tmp_path / "here"}) for _ in range(2)] == [(8.0, 0), (8.0, 1)]


def test_kernels_work_where_nothing_can_be_written(copied: Path):
    command = [copied / "backend" / "caller.py"]
    for _ in range(2):
        done = python(
            *command, env=environment(copied), preexec_fn=lambda: resource.setrlimit(FILES, (0, 0))
        )
        assert (done.stdout, done.stderr) == ("8.0 0\n", "")


@pytest.mark.parametrize(
    ("name", "old", "new", "value"),
    [
        ("called", "x + 1.0", "x + 2.0", 10.0),
        ("plain", "FACTOR = 2.0", "FACTOR = 20.0", 80.0),
        (
            "plain",
            "    first: float\n    second: float\n",
            "    second: float\n    first: float\n",
            8.0,
        ),
    ],
)
def test_changed_sources_never_find_old_kernels(
    copied: Path, tmp_path: Path, name, old, new, value
):
    """Changes in a called kernel, in a constant or in a named tuple all cause a new compilation."""
    assert called(copied, NUMBA_CACHE_DIR=tmp_path) == (8.0, 0)
    path = copied / "backend" / f"{name}.py"
    path.write_text(path.read_text().replace(old, new))
    assert called(copied, NUMBA_CACHE_DIR=tmp_path) == (value, 0)


def test_processes_that_keep_the_same_kernel_at_once(copied: Path, tmp_path: Path):
    command, variables = (
        [sys.executable, copied / "backend" / "caller.py"],
        environment(copied, HOME=tmp_path),
    )
    ranks = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=variables)
        for _ in range(4)
    ]
    assert {rank.communicate()[0].split()[0] for rank in ranks} == {"8.0"}
    assert called(copied, HOME=tmp_path) == (8.0, 1)


def test_a_kernel_that_is_damaged_on_the_disk_is_compiled_anew(copied: Path, tmp_path: Path):
    assert called(copied, HOME=tmp_path) == (8.0, 0)
    for content in (b"", b"\0" * 1000):
        for path in tmp_path.glob(".cache/*/*"):
            path.write_bytes(content)
        assert called(copied, HOME=tmp_path) == (8.0, 0)
        assert called(copied, HOME=tmp_path) == (8.0, 1)


def test_a_disk_that_is_full_keeps_nothing(chosen: Path):
    kernel_cache.save("b", b"code")
    assert kernel_cache.load("b") == b"code" and not kernel_cache.is_empty()
    (stored,) = chosen.iterdir()
    _, most = resource.getrlimit(FILES)
    try:
        resource.setrlimit(FILES, (0, most))
        kernel_cache.save("a", bytes(100))
        kernel_cache.folders.cache_clear()
        assert kernel_cache.writable() is None
    finally:
        resource.setrlimit(FILES, (most, most))
    assert kernel_cache.load("a") is None and [*chosen.iterdir()] == [stored]


def test_kernels_of_a_folder_that_cannot_be_written_are_found(copied: Path, tmp_path: Path):
    """Kernels in a read-only image are used; missing kernels are stored elsewhere."""
    if not os.getuid():
        pytest.skip("root can write to any folder: scripts/bare tries it as a user")
    assert called(copied, NUMBA_CACHE_DIR=tmp_path) == (8.0, 0)
    (folder,) = tmp_path.glob("msmpetsc-kernels-*")
    folder.chmod(0o555)
    assert called(copied, NUMBA_CACHE_DIR=tmp_path, HOME=tmp_path) == (8.0, 1)


def test_every_kernel_is_kept_in_this_way():
    for path in PACKAGE.rglob("*.py"):
        assert path.name == "kernel.py" or "numba.njit" not in path.read_text(), path


# Prints a product of a random block of cells, and the number of kernels found compiled
PRODUCT = """
import numpy as np
from msmpetsc.elasticity.cell_blocks import LANES, PROJECTED, ROWS, CellBlocks
from msmpetsc.elasticity.cell_lanes import add_product
rng = np.random.default_rng(0)
nodes = np.arange(8 * LANES, dtype=np.uint32).reshape(1, LANES, 8)
around, which = np.empty((8, 0), np.int64), np.zeros(1, np.int32)
constants, state, v = (
    rng.uniform(0.5, 1.5, shape) for shape in ((1, ROWS * LANES), (1, PROJECTED * LANES), (64, 3))
)
product = np.zeros_like(v)
add_product(CellBlocks(nodes, which, constants, around, 1, 0.1, 0), state, v, product)
print(product.tobytes().hex(), sum(add_product.stats.cache_hits.values()))
"""


def test_a_run_that_compiles_computes_the_same_bits_as_later_runs(tmp_path: Path):
    """LLVM reorders sums, so a function optimised on its own and in its caller gives other bits."""
    given = ENVIRONMENT | {"NUMBA_CACHE_DIR": str(tmp_path)}
    first, then = (python("-c", PRODUCT, env=given).stdout.split() for _ in range(2))
    assert (first[1], then[1]) == ("0", "1") and first[0] == then[0]
