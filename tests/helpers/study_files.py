"""Study files, their tables and pages, for tests of studies; runs are stand-ins."""

import csv
import re
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser
from pathlib import Path

import pytest
from conftest import ENVIRONMENT
from study_stand_in import stands_in

from msmpetsc.comm import log
from msmpetsc.study import runner
from msmpetsc.study.cases import Case, study_cases
from msmpetsc.study.runner import run_study
from msmpetsc.study.study_file import load_study
from msmpetsc.study.table import COLUMNS, read_table, records

SCENE = """
mesh = { source = "box.ply" }
cages = { count = 10 }
material = { young_modulus = 1e5, density = 1000, law = "linear" }
time = { step = 0.01, duration = 0.1 }
"""

ONE_SCENE = '[[scene]]\nname = "a"\nfile = "scene.toml"\n'


@pytest.fixture
def stand_in(monkeypatch):
    """Make cases run the stand-in instead of the program."""
    monkeypatch.setattr(runner, "command", stands_in)
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)


@pytest.fixture
def own_log():
    """Restore the log after the test, because the command line sets it up."""
    before = log.handlers, log.level
    yield
    log.handlers, log.level = before


def study_file(folder: Path, text: str) -> Path:
    (folder / "scene.toml").write_text(SCENE)
    path = folder / "study.toml"
    path.write_text(text)
    return path


def carry_out(folder: Path, text: str, **options) -> list[dict]:
    """Return the rows of a study in this folder."""
    run_study(study_file(folder, text), folder / "out", **options)
    return records(read_table(folder / "out"))


def calls(folder: Path) -> list[str]:
    path = folder / "out" / "calls.txt"
    return path.read_text().splitlines() if path.exists() else []


def all_cases(folder: Path, text: str, full: bool = False) -> list[Case]:
    return study_cases(load_study(study_file(folder, text)), folder, full)


def alive(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False


# HTML elements without an end tag
VOID = {"meta", "br"}


def row_of(label: str, **given) -> dict[str, str]:
    """Return a row of the table as text; some columns follow from the time of a frame."""
    row = {"label": label, "preset": label, "scene": "block", "status": "ok", "study": "try"}
    row |= {"time_step": 0.01, "cells": 1000, "ranks": 1} | given
    if row.get("time_frame"):
        row |= {"fps": 1 / row["time_frame"], "time_second": row["time_frame"] / row["time_step"]}
    changes = " ".join(f"--set {name}={value}" for name, value in given.items())
    row |= {"command": f"msmpetsc run {changes}"}
    return {name: str(value) for name, value in row.items()}


def write_rows(folder: Path, rows: list[dict[str, str]]) -> Path:
    with (folder / "table.csv").open("w", newline="") as stream:
        table = csv.DictWriter(stream, COLUMNS, extrasaction="ignore")
        table.writeheader()
        table.writerows(rows)
    return folder


def spaced(text: str) -> str:
    """Return the text with plain spaces between numbers and units."""
    return text.replace("\N{NO-BREAK SPACE}", " ")


def svgs(text: str) -> list[ElementTree.Element]:
    return [ElementTree.fromstring(svg) for svg in re.findall(r"<svg.*?</svg>", text, re.DOTALL)]


def tooltips(text: str) -> list[str]:
    name = "{http://www.w3.org/2000/svg}title"
    return [title.text for svg in svgs(text) for title in svg.iter(name)]


class Balance(HTMLParser):
    """Parser of HTML that fails if an element ends that is not open."""

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, _attributes):
        self.open += [tag] if tag not in VOID else []

    def handle_endtag(self, tag):
        assert self.open.pop() == tag
