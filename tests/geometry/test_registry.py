"""Named models: search places, download (from this machine only), and the command."""

import hashlib
import sys
import threading
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import trimesh
from one_process import input_error

from msmpetsc.cli.commands import fetch as command
from msmpetsc.cli.main import parsed
from msmpetsc.errors import InputError
from msmpetsc.geometry.readers import read_surface
from msmpetsc.geometry.registry import MODELS, NamedMesh, fetch, load, locate


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


BOX = trimesh.creation.box()
# loose triangles: 36 points
ORIGINAL = BOX.export(file_type="stl")
# 8 points
COPY = BOX.export(file_type="ply")


class QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, *args):
        pass


@pytest.fixture
def site(tmp_path):
    """Yield a folder, and the address at which a server on this machine serves it."""
    folder = tmp_path / "site"
    folder.mkdir()
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(QuietHandler, directory=folder))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield folder, f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
    thread.join(timeout=5)


@pytest.fixture
def toy(site, tmp_path, monkeypatch):
    """Register 'toybox', whose original can be downloaded, and 'toyscan', from a package.

    All places for meshes are empty.
    """
    folder, address = site
    (folder / "box.stl").write_bytes(ORIGINAL)
    for name in ("meshes", "packages", "cache"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("MSMPETSC_MESH_DIR", str(tmp_path / "meshes"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(tmp_path / "packages")
    model = NamedMesh(
        copy="toybox.ply",
        copy_sha256=sha256(COPY),
        licence="free",
        credit="nobody",
        downloads={f"{address}/box.stl": sha256(ORIGINAL)},
        steps=("merge",),
    )
    monkeypatch.setitem(MODELS, "toybox", model)
    monkeypatch.setitem(
        MODELS, "toyscan", replace(model, downloads={}, packaged="toypackage/data/box.ply")
    )
    return tmp_path


def install(folder: Path, content: bytes) -> Path:
    """Write a package with a file in it; it must not be imported."""
    path = folder / "packages/toypackage/data/box.ply"
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    (folder / "packages/toypackage/__init__.py").write_text("raise SystemExit('imported')")
    return path


def test_the_copy_goes_before_what_was_fetched_or_lies_in_a_package(toy):
    with pytest.raises(InputError, match=r"^mesh 'toybox' is not here: msmpetsc fetch toybox$"):
        locate("toybox", toy)
    with pytest.raises(
        InputError, match=r"'toyscan' is not here: it comes with a package, pip .* toypackage$"
    ):
        fetch("toyscan")
    packaged = install(toy, COPY)
    assert locate("toyscan", toy) == packaged and "toypackage" not in sys.modules
    fetched = fetch("toybox")
    assert fetched.read_bytes() == ORIGINAL and fetched.is_relative_to(toy / "cache")
    assert locate("toybox", toy) == fetched
    (toy / "meshes/toybox.ply").write_bytes(COPY)
    assert locate("toybox", toy) == locate("toyscan", toy) == toy / "meshes/toybox.ply"


def test_a_name_gives_the_same_surface_wherever_it_is_found(toy):
    install(toy, COPY)
    packaged = load("toyscan", toy)
    fetch("toybox")
    fetched = load("toybox", toy)
    (toy / "meshes/toybox.ply").write_bytes(COPY)
    copy = load("toybox", toy)
    assert len(copy.points) == 8

    def corners(surface):
        return np.sort(surface.points[surface.triangles].reshape(12, 9), axis=0)

    for surface in (packaged, fetched):
        assert len(surface.points) == 8
        assert np.array_equal(corners(surface), corners(copy))


def test_another_file_under_the_name_is_refused(toy):
    # another version of the package counts as missing
    install(toy, ORIGINAL)
    with pytest.raises(InputError, match="comes with a package"):
        locate("toyscan", toy)
    fetch("toybox").write_bytes(COPY)
    with pytest.raises(InputError, match="SHA-256 differs"):
        locate("toybox", toy)
    (toy / "meshes/toybox.ply").write_bytes(COPY + b"\n")
    with pytest.raises(InputError, match="SHA-256 differs"):
        locate("toybox", toy)


def test_a_model_of_several_files_is_here_only_with_all_of_them(toy, site, monkeypatch):
    folder, address = site
    (folder / "box.bin").write_bytes(b"more")
    more = {f"{address}/box.bin": sha256(b"more")}
    model = MODELS["toybox"]
    monkeypatch.setitem(MODELS, "toybox", replace(model, downloads=model.downloads | more))
    path = fetch("toybox")
    assert path.name == "box.stl" and path.with_name("box.bin").read_bytes() == b"more"
    path.with_name("box.bin").unlink()
    with pytest.raises(InputError, match="is not here"):
        locate("toybox", toy)


def test_a_fetched_file_is_checked(toy, site):
    (site[0] / "box.stl").write_bytes(COPY)
    assert "SHA-256 differs" in input_error(lambda: fetch("toybox"))
    with pytest.raises(InputError, match="is not here"):
        locate("toybox", toy)


def test_a_failed_connection_is_one_line(toy, site, monkeypatch, capfd):
    folder, _ = site
    (folder / "box.stl").unlink()
    with pytest.raises(InputError, match=r"cannot fetch .*HTTP status 404"):
        fetch("toybox")
    # no server answers at this address
    closed = {"http://127.0.0.1:9/box.stl": sha256(ORIGINAL)}
    monkeypatch.setitem(MODELS, "toybox", replace(MODELS["toybox"], downloads=closed))
    assert "ConnectionError" in input_error(lambda: fetch("toybox"))
    assert capfd.readouterr() == ("", "")


def test_the_command_fetches_and_lists(toy, capsys):
    assert command.run(parsed(["fetch", "--list"])) == 0
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert set(MODELS) <= set(rows) and "not here" in rows["toybox"] and "free" in rows["toybox"]

    assert command.run(parsed(["fetch", "toybox"])) == 0
    output = capsys.readouterr().out
    path = output.splitlines()[0].removeprefix("toybox: ")
    assert len(read_surface(path).triangles) == 12 and "nobody (free)" in output

    (toy / "meshes/bunny.ply").write_bytes(b"not the bunny")
    assert command.run(parsed(["fetch", "--list"])) == 0
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert "fetched" in rows["toybox"] and "another file" in rows["bunny"]
    for words, told in (
        (["fetch"], "fetch which mesh"),
        (["fetch", "armadilo"], "did you mean 'armadillo'"),
    ):
        with pytest.raises(InputError, match=told):
            command.run(parsed(words))
