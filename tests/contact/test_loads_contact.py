"""Regions, and forces shared out over them."""

import numpy as np
import pytest
from mpi4py import MPI

from msmpetsc.constraints.forces import Load, shares_by_mass
from msmpetsc.constraints.time_functions import Timed, total_of
from msmpetsc.geometry.inside import inside
from msmpetsc.scene.body import Region

# box of sides 4, 2 and 1 m
BOUNDS = np.array([[-1.0, 0.0, 2.0], [3.0, 2.0, 3.0]])


def holds(region: dict, *points: list[float]) -> list[bool]:
    return inside(Region.model_validate(region), np.array(points, float), BOUNDS).tolist()


def test_box_absolute_and_relative():
    box = {"box": [[0, 0, 0], [1, 1, 0.5]]}
    assert holds(box, [0, 0, 0], [1, 1, 0.5], [0.5, 0.5, 0.51], [-0.01, 0.5, 0.2]) == [
        True,
        True,
        False,
        False,
    ]
    # relative: x from -1 to 3, y from 0 to 2, z from 2 to 2.5
    points = [[-1, 0, 2], [3, 2, 2.5], [3.01, 1, 2.2], [0, 1, 2.51], [0.5, 0.5, 0.2]]
    # at the body's own bounds in x, in y and below it is open outwards: cells stick out
    # there
    assert holds(box | {"relative": True}, *points) == [True, True, True, False, True]


def test_sphere_absolute_and_relative():
    ball = {"sphere": {"center": [0.5, 0.5, 0.5], "radius": 0.25}}
    assert holds(ball, [0.5, 0.5, 0.75], [0.5, 0.25, 0.5], [0.7, 0.7, 0.5]) == [True, True, False]
    # relative: centre at (1, 1, 2.5), the radius a quarter of the longest side, so 1;
    # it stays round
    points = [[2, 1, 2.5], [1, 2, 2.5], [1, 1, 1.5], [2.01, 1, 2.5], [1, 1, 3.51]]
    assert holds(ball | {"relative": True}, *points) == [True, True, True, False, False]


def test_half_space_absolute_and_relative():
    half = {"half_space": {"point": [0, 0, 0.5], "normal": [0, 3, 4]}}
    assert holds(half, [9, 0, 0.5], [0, 4, -2.5], [0, 4, -2.51], [0, -0.1, 0.5]) == [
        True,
        True,
        False,
        False,
    ]
    # relative: the point is (-1, 0, 2.5), the normal is not scaled
    assert holds(half | {"relative": True}, [0, 4, -0.5], [0, 4, -0.51]) == [True, False]


def test_force_is_shared_out_by_mass():
    mass = np.array([1.0, 2.0, 5.0, 4.0])
    where = np.array([True, True, False, True])
    load = Load(share=shares_by_mass(MPI.COMM_SELF, where, mass), total=total_of((7.0, 0.0, -14.0)))
    assert load.share * load.state_at(1.0) == pytest.approx(
        np.array([[1, 0, -2], [2, 0, -4], [0, 0, 0], [4, 0, -8]])
    )


def test_a_time_that_is_rounded_beside_start_or_stop_counts_as_it():
    late = np.nextafter(1.8, 0)
    assert not Timed(stop=1.8).acts_at(late) and Timed(start=1.8, stop=2.0).acts_at(late)
