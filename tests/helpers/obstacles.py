"""Planes, boxes and spheres as obstacles."""

import numpy as np

from msmpetsc.model.contact.obstacle import Obstacle
from msmpetsc.model.loads import Motion

STILL = Motion.through(())


def plane(point: list[float], normal: list[float], path: Motion = STILL, **times: float) -> Obstacle:
    normal = np.array(normal) / np.linalg.norm(normal)
    return Obstacle(np.array([point], float), normal[None], path, **times)


def box(low: list[float], high: list[float], path: Motion = STILL, **times: float) -> Obstacle:
    points = np.repeat(np.array([low, high], float), 3, axis=0)
    return Obstacle(points, np.concatenate([-np.eye(3), np.eye(3)]), path, **times)


def sphere(center: list[float], radius: float, path: Motion = STILL, **times: float) -> Obstacle:
    return Obstacle(np.array([center], float), np.zeros((1, 3)), path, **times, radius=radius)
