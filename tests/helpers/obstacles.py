"""Planes, boxes and spheres as obstacles."""

import numpy as np

from msmpetsc.constraints.time_functions import Motion
from msmpetsc.contact.obstacles.moving_solid import Obstacle
from msmpetsc.contact.obstacles.solids import BallSolid, Faces, Planes

STILL = Motion.through(())


def plane(
    point: list[float], normal: list[float], path: Motion = STILL, **times: float
) -> Obstacle:
    normal = np.array(normal) / np.linalg.norm(normal)
    return Obstacle(Faces(Planes(np.array([point], float), normal[None])), path, **times)


def box(low: list[float], high: list[float], path: Motion = STILL, **times: float) -> Obstacle:
    return Obstacle(Faces.of_box(np.array(low), np.array(high)), path, **times)


def sphere(center: list[float], radius: float, path: Motion = STILL, **times: float) -> Obstacle:
    return Obstacle(BallSolid(np.array(center, float), radius), path, **times)
