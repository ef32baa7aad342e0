"""The script that makes a PETSc with CUDA: what it says before it makes anything."""

import shutil
import subprocess
from pathlib import Path

import pytest
from conftest import ROOT

SCRIPT = ROOT / "scripts" / "build_petsc_cuda"
TOOLS = ("bash", "cat", "dirname", "env", "ls", "mkdir", "nproc", "paste", "realpath", "sort")


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """A folder of a PATH without apt-get, compilers and GPUs."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for tool in TOOLS:
        (folder / tool).symlink_to(shutil.which(tool))
    return folder


def build(path: Path, prefix: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess:
    """The script with this PATH and prefix."""
    command = ["bash", SCRIPT, "--prefix", prefix, *arguments]
    clean = {"PATH": str(path), "HOME": str(prefix), **variables}
    return subprocess.run(command, env=clean, capture_output=True, text=True, timeout=20)


def program(folder: Path, name: str, text: str) -> None:
    (folder / name).write_text(f"#!/usr/bin/env bash\n{text}\n")
    (folder / name).chmod(0o755)


@pytest.mark.parametrize(
    "arguments, said",
    [
        (("--arch",), "needs a value"),
        (("--arch", "sm_90"), "sm_90"),
        (("--arch", "90", "--jobs", "0"), "--jobs 0"),
        (("--march", "90"), "unknown option --march"),
        (("--arch", "90", "--", "--with-mumps=1"), "no C++ compiler"),
    ],
)
def test_what_is_missing_is_one_line(bare: Path, tmp_path: Path, arguments: tuple, said: str) -> None:
    done = build(bare, tmp_path / "petsc", *arguments)
    assert done.returncode == 2 and said in done.stderr and done.stderr.count("\n") == 1, done
    assert done.stdout == "" and not (tmp_path / "petsc").exists()


def test_who_may_not_install_is_told_what_to_ask_for(bare: Path, tmp_path: Path) -> None:
    program(bare, "apt-get", "exit 1")
    program(bare, "dpkg-query", '[ "${@: -1}" = g++ ] && echo installed')
    program(bare, "id", "echo 1000")
    done = build(bare, tmp_path / "petsc", "--arch", "90")
    assert done.returncode == 2 and "libmumps-dev" in done.stderr and "g++" not in done.stderr, done
    assert done.stderr.count("\n") == 1 and not (tmp_path / "petsc").exists()


def test_a_folder_of_others_is_left_alone(bare: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("keep")
    done = build(bare, tmp_path, "--arch", "90")
    assert done.returncode == 2 and "holds something else" in done.stderr and (tmp_path / "mine").exists()


def test_what_is_made_is_not_made_again(bare: Path, tmp_path: Path) -> None:
    """Two cards of one kind and one of another name the build; the same call then only prints what to export."""
    program(bare, "nvidia-smi", "printf '9.0\\n8.0\\n9.0\\n'")
    prefix = tmp_path / "petsc"
    prefix.mkdir()
    (prefix / ".key").write_text("petsc 3.26.1, sm 80,90, options --with-x=1\n")
    (prefix / ".made").touch()
    (prefix / "env").write_text("export PETSC_DIR=there\n")
    done = build(bare, prefix, "--", "--with-x=1")
    assert (done.returncode, done.stdout) == (0, "export PETSC_DIR=there\n"), done
    assert build(bare, prefix, "--", "--with-x=2").returncode == 2  # another build: goes on to look for compilers
