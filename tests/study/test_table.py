"""The table of a study: numbers as text, reading and writing, and what loads pandas."""

# ruff: noqa: F811 (fixtures are imported)
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ENVIRONMENT
from study_files import (
    ONE_SCENE,
    carry_out,
    stand_in,  # noqa: F401 (fixtures)
)

from msmpetsc.errors import InputError
from msmpetsc.study.table import COLUMNS, read_table, records, write_table


class NumberOfNumPy2(float):
    def __repr__(self) -> str:
        return f"np.float64({float(self)!r})"


def test_a_number_shows_no_type_in_a_table(tmp_path: Path):
    row = {"case": "1", "time_step": NumberOfNumPy2(1e-3)}
    write_table(tmp_path, [row | {name: 1 for name, column in COLUMNS.items() if column.kind is int}])
    assert ",0.001," in (tmp_path / "table.csv").read_text()


def test_a_table_read_and_written_again_is_the_same_text(tmp_path: Path):
    row = {"case": "1", "cells": 1009, "steps": 8, "time_step": 1e-3, "fps": 121.25, "memory": 4e8, "error": None}
    row |= {name: 1 for name, column in COLUMNS.items() if column.kind is int}
    write_table(tmp_path, [row])
    once = (tmp_path / "table.csv").read_text()
    write_table(tmp_path, records(read_table(tmp_path)))
    assert (tmp_path / "table.csv").read_text() == once and ",1009," in once


def test_a_table_that_is_none_is_one_line(tmp_path: Path, stand_in):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "table.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="--restart begins anew"):
        carry_out(tmp_path, ONE_SCENE + "[[sweep]]")


def test_only_a_table_and_its_charts_load_what_they_need():
    """A plan and the start of a study do without pandas, vl-convert and jinja2."""
    modules = "msmpetsc.study.runner, msmpetsc.study.sizing.trials, msmpetsc.cli.main"
    loaded = "sorted({'pandas', 'vl_convert', 'jinja2'} & set(sys.modules))"
    words = [sys.executable, "-c", f"import sys, {modules}; print({loaded})"]
    done = subprocess.run(words, env=ENVIRONMENT, capture_output=True, text=True, timeout=60)
    assert done.stdout == "[]\n", done.stderr
