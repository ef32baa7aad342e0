"""Regions select points, and forces are distributed over them."""

import numpy as np
import pytest
from mpi4py import MPI

from msmpetsc.constraints.forces import Load, shares_by_mass
from msmpetsc.constraints.time_functions import Timed, total_of
from msmpetsc.geometry.inside import inside
from msmpetsc.scene.body import Region

# box of sides 4, 2 and 1 m
BOUNDS = np.array([[-1.0, 0.0, 2.0], [3.0, 2.0, 3.0]])

BOX = {"box": [[0, 0, 0], [1, 1, 0.5]]}
SPHERE = {"sphere": {"center": [0.5, 0.5, 0.5], "radius": 0.25}}
HALF_SPACE = {"half_space": {"point": [0, 0, 0.5], "normal": [0, 3, 4]}}
# region, points inside the region, and points outside
REGIONS = [
    (BOX, [[0, 0, 0], [1, 1, 0.5]], [[0.5, 0.5, 0.51], [-0.01, 0.5, 0.2]]),
    # x from -1 to 3, y from 0 to 2, z from 2 to 2.5; a side at the body's bounding box
    # is open, so that protruding cells count
    (
        BOX | {"relative": True},
        [[-1, 0, 2], [3, 2, 2.5], [3.01, 1, 2.2], [0.5, 0.5, 0.2]],
        [[0, 1, 2.51]],
    ),
    (SPHERE, [[0.5, 0.5, 0.75], [0.5, 0.25, 0.5]], [[0.7, 0.7, 0.5]]),
    # centre at (1, 1, 2.5), radius 1, a quarter of the longest side; the region stays
    # round
    (
        SPHERE | {"relative": True},
        [[2, 1, 2.5], [1, 2, 2.5], [1, 1, 1.5]],
        [[2.01, 1, 2.5], [1, 1, 3.51]],
    ),
    (HALF_SPACE, [[9, 0, 0.5], [0, 4, -2.5]], [[0, 4, -2.51], [0, -0.1, 0.5]]),
    # the point is (-1, 0, 2.5); the normal is not scaled
    (HALF_SPACE | {"relative": True}, [[0, 4, -0.5]], [[0, 4, -0.51]]),
]


@pytest.mark.parametrize(("region", "within", "beyond"), REGIONS)
def test_a_region_holds_its_points_alone(region: dict, within: list, beyond: list):
    points = np.array(within + beyond, float)
    found = inside(Region.model_validate(region), points, BOUNDS)
    assert found.tolist() == [True] * len(within) + [False] * len(beyond)


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
