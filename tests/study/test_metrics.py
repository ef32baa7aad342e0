"""The figures of a run: error against a reference, means of steps, medians of repeats."""

import math
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from scipy.spatial.transform import Rotation

from msmpetsc.errors import InputError
from msmpetsc.fields import Frame
from msmpetsc.results.writer import ResultFile
from msmpetsc.study.metrics import (
    distance_of_shapes,
    frame_metrics,
    merge_repeats,
    trajectory_error,
)


def result(
    path: Path, times: list[float], positions: list[np.ndarray], mass: list[float], **series
) -> Path:
    """Write a result with positions (n, 3) at each time, the first at rest."""
    with ResultFile(path, MPI.COMM_SELF, {"scene": ""}) as file:
        file.write("lattice/nodes", positions[0])
        file.write("lattice/mass", np.array(mass, float))
        file.start_frames(len(times), len(mass))
        for index, now in enumerate(times):
            values = {name: column[index] for name, column in series.items()}
            file.append(Frame(index=index, time=now, position=positions[index], **values))
    return path


def test_the_trajectory_error_of_a_motion_by_hand(tmp_path: Path):
    """Two nodes have masses of 1 and 4 kg, and the error is the root of 8 / 25.

    Node 0 moves by 3 and 0 at the two common times, node 1 by 0 and 2. Node 1 is off by 1 once,
    node 0 by 2 once.
    """
    rest = np.array([[0.0, 0, 0], [1, 0, 0]])
    x, z = np.array([[1.0, 0, 0], [0, 0, 0]]), np.array([[0.0, 0, 0], [0, 0, 1]])
    reference = result(tmp_path / "r.h5", [0, 0.1, 0.2], [rest, rest + 3 * x, rest + 2 * z], [1, 4])
    times = [0, 0.05, 0.1 + 1e-12, 0.15, 0.2]
    positions = [rest, rest + 99, rest + 3 * x + z, rest - 99, rest + 2 * z + 2 * x]
    run = result(tmp_path / "x.h5", times, positions, [1, 4])
    assert trajectory_error(run, reference) == pytest.approx(np.sqrt(8 / 25))
    assert trajectory_error(reference, reference) == 0


def test_runs_without_common_times_or_nodes_have_no_trajectory_error(tmp_path: Path):
    rest = np.zeros((1, 3))
    reference = result(tmp_path / "r.h5", [0, 0.1], [rest, rest + 1], [1])
    with pytest.raises(InputError, match="nothing moves in it at the times of"):
        trajectory_error(result(tmp_path / "a.h5", [0, 0.03], [rest, rest], [1]), reference)
    with pytest.raises(InputError, match="different lattices"):
        trajectory_error(result(tmp_path / "b.h5", [0, 0.1], [rest + 1, rest], [1]), reference)
    with pytest.raises(InputError, match="nothing moves"):
        trajectory_error(reference, result(tmp_path / "c.h5", [0, 0.1], [rest, rest], [1]))


def test_means_are_of_steps_and_leave_the_first_frame_out(tmp_path: Path):
    """Frames of 2 steps take 9 s, 2 s and 4 s of computing; the first does not count."""
    positions = [np.zeros((1, 3))] * 4
    file = result(
        tmp_path / "x.h5", [0, 0.2, 0.4, 0.6], positions, [1], wall_time=[0, 9.0, 2.0, 4.0],
        iterations=[0, 50, 4, 8],
        ksp_its=[0, 0, 40, 0], products=[0, 0, 60, 12], step_error=[0, 0.3, 0.4, 0.0],
    )  # fmt: skip
    row = frame_metrics(file, 0.1)
    assert (row["frames"], row["steps"]) == (4, 6)
    assert row["time_frame"] == pytest.approx(6 / 4)
    assert (row["iterations"], row["ksp_its"], row["products"]) == (3, 10, 18)
    assert row["estimated_error"] == pytest.approx(np.sqrt((0.09 + 0.16) / 3))


def test_repeats_become_medians_with_their_range_and_a_single_run_has_none():
    known = ((0.3, 9, 0.1), (0.1, 7, None), (0.2, 8, None))
    runs = [
        {"time_frame": time, "memory": memory, "true_error": error} for time, memory, error in known
    ]
    ends = {"time_frame_min": 0.1, "time_frame_max": 0.3}
    assert merge_repeats(runs) == {"time_frame": 0.2, "memory": 7, "true_error": 0.1} | ends
    assert merge_repeats(runs[:1]) == runs[0]
    assert merge_repeats([*runs[:2], {}]).items() >= ({"time_frame": 0.2} | ends).items()


def block(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform([0, 0, 0], [4, 2, 1], (50, 3)), rng.uniform(1, 3, 50)


def test_a_rigid_motion_is_no_error_of_shape():
    rest, mass = block()
    moved = Rotation.from_rotvec([1, 2, -2]).apply(rest) + np.array([5, -7, 100])
    assert distance_of_shapes(moved, rest, mass) < 1e-12


def test_the_error_of_a_swollen_body_by_hand():
    """Growth by 10% gives a tenth of the root mean square distance from the centre of mass."""
    rest, mass = block()
    centre = mass @ rest / mass.sum()
    spread = math.sqrt(mass @ ((rest - centre) ** 2).sum(axis=1) / mass.sum())
    expected = 0.1 * spread / np.ptp(rest, axis=0).max()
    assert distance_of_shapes(1.1 * rest, rest, mass) == pytest.approx(expected)


def test_a_mirrored_body_is_not_in_its_rest_shape():
    """The best mirror plane is across the thinnest side: two masses at +-a are off by 2 a."""
    rest = np.array(
        [[2.0, 0, 0], [-2, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 0.5], [0, 0, -0.5], [1, 0.5, 0.3]]
    )
    assert distance_of_shapes(rest * [1, 1, -1], rest, np.ones(7)) > 0.02


def test_energy_is_not_compared_where_a_load_acts_and_a_number_that_is_none_has_no_shape(
    tmp_path: Path,
):
    rest, mass = block()
    positions = [rest, *[rest + math.nan] * 3]
    energies = {"kinetic": [1] * 4, "potential": [0, 0, 0, -1]}
    path = result(tmp_path / "x.h5", [0, 0.1, 0.2, 0.3], positions, mass, **energies)
    row = frame_metrics(path, 0.1)
    assert "energy_left" not in row and row["shape_error"] is None
