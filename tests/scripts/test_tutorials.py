"""The tutorials run as scripts; their own assertions check the numbers."""

import re
from pathlib import Path

import pytest
from conftest import ROOT, python

from msmpetsc.errors import InputError
from msmpetsc.geometry.registry import locate

TUTORIALS = ROOT / "scripts" / "docs" / "pages" / "tutorials"
SLOW = ("organ", "solvers")


@pytest.mark.parametrize(
    "script",
    [
        pytest.param(path, id=path.stem, marks=[pytest.mark.slow] * (path.stem in SLOW))
        for path in sorted(TUTORIALS.glob("*.py"))
    ],
)
def test_a_tutorial_runs(script: Path, tmp_path: Path):
    if script.stem == "organ":
        try:
            locate("heart_vessels", str(ROOT))
        except InputError as error:
            pytest.skip(str(error))
    done = python(script, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    for printed in re.findall(r"# It prints:\n#\n((?:#     .*\n)+)", script.read_text()):
        assert re.sub(r"^#     ", "", printed, flags=re.M) in done.stdout, done.stdout
