"""A whole run by the command line satisfies its equations by the data of its file."""

import h5py
import numpy as np
import pytest
from conftest import ROOT
from one_process import status_of

pytest.importorskip("pymeshfix", reason="the bunny comes with pymeshfix")

GRAVITY = np.array([0, 0, -9.81])


@pytest.fixture(scope="module")
def fall(tmp_path_factory: pytest.TempPathFactory) -> h5py.File:
    """Run the shipped scene at its own time step until it has struck the ground, solved tightly."""
    path = tmp_path_factory.mktemp("runs") / "fall.h5"
    # cells of 23 mm
    words = "--set cages.count=600 --preset newton --error 1e-9 --frames 125"
    assert status_of("run", ROOT / "scenes" / "bunny_fall.toml", "-o", path, *words.split()) == 0
    return h5py.File(path)


def frames_before_contact(file: h5py.File) -> int:
    return int(np.argmax(file["frames/position"][:, :, 2].min(axis=1) <= 0))


def test_the_residual_of_every_step_before_contact_from_the_file_alone(fall: h5py.File):
    ends, r, k, m = (
        fall["lattice"][name][:] for name in ("springs", "rest_length", "stiffness", "mass")
    )
    q, t = fall["frames/position"], fall["frames/time"][1]
    scale = np.linalg.norm(m[:, None] * GRAVITY * t**2)
    # in the step after these frames the ground pushes
    for n in range(frames_before_contact(fall) - 1):
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
