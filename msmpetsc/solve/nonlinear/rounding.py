"""Rounding errors of a step: nothing is known better than that, and no error is smaller."""

import sys

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Floats, greatest
from msmpetsc.errors import StepFailed
from msmpetsc.solve.nonlinear.functional import StepFunctional

ROUNDINGS = 3 * np.finfo(float).eps  # of a row of F: in free fall one eps was passed now and then
SINGLE_ROW = 10.0  # times as much in a single row
NEGLIGIBLE = 1e-6  # of the body's size: rounding that moves it less is of no concern
HOPELESS = 0.3  # of what its forces move a body: rounding that moves it more leaves no step to speak of


class Rounding:
    """Rounding in the steps of one lattice and time step. All methods are collective.

    diagonal : (m,) of each free node of this rank: its inertia, and t^2 times how stiff it is at rest [kg]
    """

    def __init__(self, functional: StepFunctional, diagonal: Floats):
        self.functional, self.comm = functional, functional.comm
        self.rows = np.tile(ROUNDINGS * diagonal, 3)  # of F [kg m] for each metre of a coordinate
        stiffness, mass = self.comm.allreduce(np.array([3 * float(diagonal.sum()), float(functional.mass.sum())]))
        # Springs or cells whose forces are k eps off move nodes by no more than sqrt(sum t^2 k) eps in the norm of H
        # where that is positive definite, and in that of M no farther; the diagonal is no less than the sum.
        self.moved, self.size = ROUNDINGS * np.sqrt(stiffness), np.sqrt(mass)

    def is_all_of(self, f: PETSc.Vec) -> bool:
        """Whether F is nothing but rounding, row by row, for soft parts have less of it than stiff ones."""
        functional = self.functional
        rows = np.abs(functional.memory.read(f)) / (self.rows * max(functional.extent, np.finfo(float).tiny))
        squares, count = self.comm.allreduce(np.array([float(rows @ rows), rows.size]))
        return bool(squares <= count and self.comm.allreduce(greatest(rows), MPI.MAX) <= SINGLE_ROW)

    @property
    def reach(self) -> float:
        """How far rounding moves the body at the most, in the norm of M."""
        return self.moved * self.functional.extent

    def relative(self, length: float, distance: float) -> float:
        """Return |e|_M over |x - y|_M, which is known no better than rounding leaves it."""
        return length / max(distance, self.reach, sys.float_info.min)

    def added_to(self, error: float, away: float, is_rounding: bool = False) -> float:
        """A relative error of a step that took x ``away`` = |x - y|_M from y, or what rounding makes of it if that is
        more; where nothing moves but by rounding, that is relative to the size of the body.

        is_rounding : F has nothing else left, which then is what made the error

        Raises StepFailed where rounding moves the body about as far as its forces do.
        """
        extent = self.functional.extent
        moved, size = self.reach, self.size * extent
        if moved > max(NEGLIGIBLE * size, HOPELESS * away):
            raise StepFailed(
                f"cannot be solved in double precision: rounding in the stiffest springs moves the body by "
                f"{moved / self.size:.1e} m, its forces by {away / self.size:.1e} m; try softer materials, less "
                "different ones, or a smaller time.step",
                "rounding",
            )
        if is_rounding and HOPELESS * away < error * away <= NEGLIGIBLE * size:
            moved = error * away  # a body at rest
        if not away > moved / HOPELESS:
            return moved / max(size, np.finfo(float).tiny)
        return max(error, moved / away)
