"""The trajectory error: how far a run is from the true motion of its lattice."""

from pathlib import Path

import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.output.compare import common_times
from msmpetsc.output.writer import finished, open_result


def trajectory_error(result: Path, reference: Path) -> float:
    """Distance of a run from a reference run, relative to how far the reference has moved [-].

        sqrt( sum_times |x - x_ref|_M^2 / sum_times |x_ref - x_rest|_M^2 )

    Sums over the times that both files have, masses M and rest positions of the lattice. x_ref stands for the limit
    of the time step to zero, so this is the error of the time step and of unfinished steps together, unlike the
    step error, which knows the step alone. Nothing else is subtracted: a body that flies as a whole counts its
    flight as motion, so the same error of its shape is a smaller figure there than of one that only swings.

    Raises InputError if the files have fewer than two times in common or different lattices, or nothing moves.
    """
    with open_result(result) as run, open_result(reference) as true:
        rest, mass = true["lattice/nodes"][:], true["lattice/mass"][:]
        if run["lattice/nodes"].shape != rest.shape:
            raise InputError(f"{result} and {reference} are runs of different lattices")
        pairs = common_times(*(file["frames/time"][: finished(file)] for file in (run, true)))
        if len(pairs) < 2:
            raise InputError(f"{result} and {reference} have {len(pairs)} times in common, 2 are needed")
        off = moved = 0.0
        for here, there in pairs:
            x, x_ref = run["frames/position"][here], true["frames/position"][there]
            off += mass @ ((x - x_ref) ** 2).sum(axis=1)
            moved += mass @ ((x_ref - rest) ** 2).sum(axis=1)
    if moved == 0:
        raise InputError(f"{reference}: nothing moves in it")
    return float(np.sqrt(off / moved))
