"""Compiled kernels are kept for just the sources that they were compiled from."""

import os
import runpy
import shutil
from pathlib import Path

import pytest
from conftest import python

import msmpetsc
from msmpetsc.backend.kernel import cache_is_empty

PACKAGE = Path(msmpetsc.__file__).parent


def test_a_change_of_any_kernels_source_gives_another_folder(tmp_path: Path):
    shutil.copytree(PACKAGE, tmp_path / "msmpetsc", ignore=shutil.ignore_patterns("__pycache__"))

    def folder() -> Path:
        return runpy.run_path(str(tmp_path / "msmpetsc" / "__init__.py"))["_kernel_folder"]()

    first = folder()
    assert first.parent == tmp_path / "msmpetsc" / "__pycache__" and folder() == first
    (tmp_path / "msmpetsc" / "scene" / "schema.py").write_text("")  # no kernels in it
    assert folder() == first
    with open(tmp_path / "msmpetsc" / "contact" / "obstacles" / "solids.py", "a") as file:
        file.write("# of another version\n")
    assert folder() != first


def test_the_users_own_folder_is_taken(tmp_path: Path):
    for given, seen in (({"NUMBA_CACHE_DIR": str(tmp_path)}, str(tmp_path)), ({}, str(PACKAGE))):
        environment = {name: x for name, x in os.environ.items() if name != "NUMBA_CACHE_DIR"} | given
        code = "import msmpetsc, numba; print(numba.config.CACHE_DIR)"
        assert python("-c", code, env=environment).stdout.startswith(seen)


def test_an_empty_cache_is_told_from_a_filled_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert cache_is_empty()
    (tmp_path / "kernel.nbi").touch()
    assert not cache_is_empty()
