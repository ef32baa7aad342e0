"""The trajectory error: how far a run is from the true motion of its lattice."""

from pathlib import Path

import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.output.compare import common_times, refuse_different_lattices
from msmpetsc.output.reader import Result


def trajectory_error(result: Path, reference: Path) -> float:
    """Distance of a run from a reference run, relative to how far the reference has moved [-].

        sqrt( sum_times |x - x_ref|_M^2 / sum_times |x_ref - x_rest|_M^2 )

    Sums over the times that both files have, masses M and rest positions of the lattice. x_ref stands for the limit
    of the time step to zero, so this is the error of the time step and of unfinished steps together, unlike the
    step error, which knows the step alone. Nothing else is subtracted: a body that flies as a whole counts its
    flight as motion, so the same error of its shape is a smaller figure there than of one that only swings.

    Raises InputError if the files have fewer than two times in common or different lattices, or nothing moves.
    """
    with Result(result) as run, Result(reference) as true:
        refuse_different_lattices(run, true)
        rest, mass = true["lattice/nodes"][:], true["lattice/mass"][:]
        pairs = common_times(run.frames.time[:], true.frames.time[:])
        if len(pairs) < 2:
            raise InputError(f"{result} and {reference} have {len(pairs)} times in common, 2 are needed")
        off = moved = 0.0
        for frame, true_frame in pairs:
            x, x_ref = run.frames.position[frame], true.frames.position[true_frame]
            off += mass @ ((x - x_ref) ** 2).sum(axis=1)
            moved += mass @ ((x_ref - rest) ** 2).sum(axis=1)
    if moved == 0:
        raise InputError(f"{reference}: nothing moves in it")
    return float(np.sqrt(off / moved))
