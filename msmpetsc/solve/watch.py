"""What is looked for in each frame and said once: cells inside out, steps that ended far from their solution."""

import numpy as np
from mpi4py import MPI

from msmpetsc.comm import log
from msmpetsc.model.lattice import Lattice
from msmpetsc.model.saved import Saved
from msmpetsc.model.worst import inverted

FAR = 0.3  # relative error of a step: a budget of iterations that leaves so much is none


class Watch:
    """Of one run. All ranks tell the same, rank 0 is heard."""

    def __init__(self, comm: MPI.Comm, lattice: Lattice):
        self.comm, self.lattice = comm, lattice
        self.frames = self.most = self.now = self.far = 0
        self.worst_error = 0.0

    def inverted(self, index: int, time: float, q: np.ndarray) -> int:
        """The number of cells inside out at q (l, 3) [m] (collective)."""
        self.now, place = inverted(self.comm, self.lattice, q)
        if self.now and not self.frames:
            log.warning(
                "frame %d (t = %.6g s): %d cell%s inside out, the worst %s; %s",
                index, time, self.now, "s are" if self.now > 1 else " is", place, self._remedy(),
            )  # fmt: skip
        self.frames += self.now > 0
        self.most = max(self.most, self.now)
        return self.now

    def error(self, index: int, time: float, error: float) -> None:
        """The estimated error of a frame's steps."""
        if not error <= FAR:
            if not self.far:
                log.warning(
                    "frame %d (t = %.6g s): its step ended %.2g off its solution, relative to what forces moved; "
                    "more solver.max_iterations, a solver.error in their place, or a smaller time.step mend that",
                    index, time, error,
                )  # fmt: skip
            self.far += 1
            self.worst_error = max(self.worst_error, error)

    def save(self, saved: Saved) -> None:
        saved.numbers |= {"frames_inverted": self.frames, "most_inverted": self.most, "now_inverted": self.now}
        saved.numbers |= {"frames_far": self.far, "worst_error": self.worst_error}

    def restore(self, saved: Saved) -> None:
        names = ("frames_inverted", "most_inverted", "now_inverted", "frames_far")
        self.frames, self.most, self.now, self.far = (saved.count(name) for name in names)
        self.worst_error = saved.numbers.get("worst_error", 0.0)

    def sum_up(self) -> None:
        """At the end of a run: how often it was."""
        if self.frames:
            left = f"{self.now} still are" if self.now else "none is at the end"
            log.warning("cells were inside out in %d frames, at most %d; %s", self.frames, self.most, left)
        if self.far:
            log.warning("steps ended far off their solution in %d frames, by up to %.2g", self.far, self.worst_error)

    def _remedy(self) -> str:
        if self.lattice.stiffening > 0:
            return "a smaller time.step or a smaller solver.error helps to keep them as they were"
        return 'springs cannot turn them back, material.law = "stiffening" can'
