"""Elastic bodies from closed surface meshes: mass-spring lattices stepped with PETSc."""

__version__ = "0.1.0"
