"""Recipes, citation and release files agree with pyproject.toml and with the version."""

import json
import re
import tomllib

import pytest
import yaml
from conftest import ROOT

import msmpetsc

PACKAGING = ROOT / "scripts" / "packaging"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# other names of packages; Spack has no Python package of libigl, and no trimesh 4
CONDA = {"libigl": "igl"}
MISSING_IN_SPACK = {"libigl", "trimesh"}
RUN = PROJECT["dependencies"] + PROJECT["optional-dependencies"]["run"]


def conda() -> dict:
    """Return the conda recipe, its Jinja expressions replaced."""
    text = (PACKAGING / "conda" / "meta.yaml").read_text()
    (version,) = re.findall(r'set version = "(.*)"', text)
    text = re.sub(r"\{%.*%\}", "", text).replace("{{ version }}", version)
    return yaml.safe_load(re.sub(r"\{\{ (\w+) \}\}", r"\1", text))


def test_all_files_name_the_version():
    cff = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    zenodo = json.loads((ROOT / ".zenodo.json").read_text())
    spack = (PACKAGING / "spack" / "package.py").read_text()
    versions = {conda()["package"]["version"], str(cff["version"]), zenodo["version"]}
    versions |= {*re.findall(r'version\("(.*?)"', spack)}
    assert versions == {msmpetsc.__version__}


@pytest.mark.parametrize("requirement", RUN)
def test_recipes_have_each_requirement(requirement: str):
    name, least = re.fullmatch(r"([\w-]+)>=([\d.]+)", requirement).groups()
    assert f"{CONDA.get(name, name)} >={least}" in conda()["requirements"]["run"]
    spack = (PACKAGING / "spack" / "package.py").read_text()
    assert name in MISSING_IN_SPACK or f'"py-{name}@{least}:"' in spack


def test_containers_install_what_setup_installs():
    words = re.findall(r"packages\+=\((.*?)\)", (ROOT / "scripts" / "setup").read_text())
    wanted = {word for line in words for word in line.split()}
    assert "python3-petsc4py" in wanted
    for name in ("Dockerfile", "apptainer.def"):
        assert wanted <= set((PACKAGING / name).read_text().split()), name


def test_the_release_stores_no_secret():
    text = (ROOT / ".github" / "workflows" / "release.yml").read_text()
    publish = yaml.safe_load(text)["jobs"]["publish"]
    assert publish["permissions"] == {"id-token": "write"} and "secrets." not in text


def test_read_the_docs_builds_our_site():
    config = yaml.safe_load((ROOT / ".readthedocs.yaml").read_text())
    assert (ROOT / config["mkdocs"]["configuration"]).exists()
    assert (ROOT / config["conda"]["environment"]).exists()


def test_the_paper_cites_what_its_bibliography_has():
    paper = (PACKAGING / "paper.md").read_text()
    cited = set(re.findall(r"@(\w+)", paper.partition("\n---\n")[2]))
    assert cited == set(re.findall(r"^@\w+\{(\w+),", (PACKAGING / "paper.bib").read_text(), re.M))
    assert 750 <= len(paper.split()) <= 1500
