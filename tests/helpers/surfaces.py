"""Surfaces and bodies from trimesh's meshes."""

import numpy as np
import trimesh
from mpi4py import MPI

from msmpetsc.geometry.cages import BodySurface
from msmpetsc.geometry.surface import Surface, bounds_of, examine


def surface_of(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.array(mesh.vertices, float), np.array(mesh.faces, np.int64))


def body_of(mesh: trimesh.Trimesh | Surface) -> BodySurface:
    surface = mesh if isinstance(mesh, Surface) else surface_of(mesh)
    return BodySurface(MPI.COMM_SELF, surface, examine(surface), bounds_of(surface))
