"""Whole runs through the command line under real mpiexec: the file alone must prove what happened."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import ROOT

pytest.importorskip("pymeshfix", reason="the bunny comes with pymeshfix")

SCENES = ROOT / "scenes"
GRAVITY = np.array([0, 0, -9.81])
SMALL = ("--set", "cages.count=600")  # cells of 23 mm
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("runs")


def run_bunny(msmpetsc, path: Path, ranks: int, *options: object) -> h5py.File:
    msmpetsc(ranks, "run", SCENES / "bunny_fall.toml", "-o", path, *SMALL, *options, timeout=200, status=0)
    return h5py.File(path)


@pytest.fixture(scope="module")
def fall(folder: Path) -> h5py.File:
    """The shipped scene at its own time step until it has struck the ground, solved tightly by newton."""
    from conftest import run

    msmpetsc = lambda ranks, *arguments, **options: run(ranks, "-m", "msmpetsc.cli.main", *arguments, **options)  # noqa: E731
    return run_bunny(msmpetsc, folder / "fall.h5", 1, "--preset", "newton", "--error", "1e-9", "--frames", 125)


def frames_before_contact(file: h5py.File) -> int:
    return int(np.argmax(file["frames/position"][:, :, 2].min(axis=1) <= 0))


def test_the_residual_of_every_step_before_contact_from_the_file_alone(fall: h5py.File):
    ends, r, k, m = (fall["lattice"][name][:] for name in ("springs", "rest_length", "stiffness", "mass"))
    q, t = fall["frames/position"], fall["frames/time"][1]
    scale = np.linalg.norm(m[:, None] * GRAVITY * t**2)
    for n in range(frames_before_contact(fall) - 1):  # in the step after these the ground pushes
        x, y = q[n + 1], 2 * q[n] - q[max(n - 1, 0)]
        along = x[ends[:, 0]] - x[ends[:, 1]]
        force = (k * (1 - r / np.linalg.norm(along, axis=1)))[:, None] * along
        gradient = np.zeros_like(x)
        np.add.at(gradient, ends[:, 0], force)
        np.add.at(gradient, ends[:, 1], -force)
        F = m[:, None] * (x - y) + t**2 * (gradient - m[:, None] * GRAVITY)
        assert np.linalg.norm(F) < 1e-8 * scale


def test_the_energies_and_momentum_of_the_file_are_those_of_its_frames(fall: h5py.File):
    m, n, t = fall["lattice/mass"][:], frames_before_contact(fall) - 1, fall["frames/time"][1]
    q, before = fall["frames/position"][n], fall["frames/position"][n - 1]
    velocity = (q - before) / t
    assert fall["frames/kinetic"][n] == pytest.approx(0.5 * m @ (velocity**2).sum(axis=1))
    assert fall["frames/potential"][n] == pytest.approx(9.81 * m @ q[:, 2])
    np.testing.assert_allclose(fall["frames/momentum"][n], m @ velocity, atol=1e-9)


HANG = (  # the bunny hangs by its ears and swings: pins, a force that ends, no contact
    "--set", "pin.0.region={box=[[0,0,0.85],[1,1,1]],relative=true}",
    "--set", "force.0={region={half_space={point=[0,0,0.1],normal=[0,0,-1]},relative=true},total=[2,0,0],stop=0.025}",
    "--set", "time.step=0.01", "--set", "time.duration=0.04", "--set", "cages.count=300",
    "--set", "material.young_modulus=1e5", "--error", "1e-10",
)  # fmt: skip


def test_three_ranks_give_the_same_file(msmpetsc, folder: Path):
    files = {ranks: run_bunny(msmpetsc, folder / f"{ranks}.h5", ranks, "--preset", "newton", *HANG) for ranks in (1, 3)}
    one = files[1]
    assert np.ptp(one["frames/position"][:], axis=0).max() > 1e-3  # it does move
    for ranks, file in files.items():
        assert file.attrs["ranks"] == ranks
        for name in ("cells", "cell_kind", "springs", "pinned"):
            np.testing.assert_array_equal(file["lattice"][name][:], one["lattice"][name][:])
        for name in ("lattice/nodes", "lattice/rest_length", "lattice/stiffness", "lattice/mass", "embedding/weights"):
            np.testing.assert_allclose(file[name][:], one[name][:], rtol=1e-13)
        moved = np.linalg.norm(one["frames/position"][:] - one["frames/position"][0])
        for name in ("position", "surface"):
            difference = np.linalg.norm(file["frames"][name][:] - one["frames"][name][:])
            assert difference < 1e-8 * moved or (name == "surface" and difference < 1e-6 * moved)
