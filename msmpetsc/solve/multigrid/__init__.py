"""Geometric multigrid on the lattice, for the true Hessian of a step."""
