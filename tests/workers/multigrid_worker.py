"""Compare multigrid on the ranks of mpiexec with multigrid on a single rank."""

import numpy as np
from hierarchies import COMM, LATTICES, SHAPES, build, hierarchy
from mpi4py import MPI

WORLD = MPI.COMM_WORLD
# lattice, shape, contact, further arguments
CASES = {
    "block": ("twisted", True, {"pins": True, "contrast": 1e6}),
    "two bodies": ("crushed", False, {}),
    "thin sheet": ("crushed", True, {"poisson": 0.25, "pins": True}),
    "limbs": ("rest", False, {"pins": True}),
    "rod": ("twisted", False, {"poisson": 0.45}),
    "a cell": ("rest", False, {}),
}


def compare_hierarchies() -> None:
    for name, (shape, contact, more) in CASES.items():
        found = []
        for comm in (WORLD, COMM):
            lattice = build(comm, LATTICES[name], **more)
            with hierarchy(comm, lattice, SHAPES[shape], contact=contact, coarsest=10) as case:
                levels = range(len(case.multigrid.levels))
                keys = [
                    np.concatenate(comm.allgather(level.grid.table.keys))
                    for level in case.multigrid.levels
                ]
                matrices = [
                    matrix(i) for i in levels for matrix in (case.interpolation, case.level)
                ]
                found.append(
                    (
                        keys,
                        [*matrices, case.hessian(), case.dense(case.multigrid.pc.apply, every=7)],
                    )
                )
        for one, several in zip(found[1][0], found[0][0], strict=True):
            np.testing.assert_array_equal(several, one)
        for one, several in zip(found[1][1], found[0][1], strict=True):
            *_, cycle = found[1][1]
            accuracy = 1e-4 if one is cycle else 1e-11
            np.testing.assert_allclose(
                several, one, rtol=0, atol=accuracy * np.abs(one).max(), err_msg=name
            )


if __name__ == "__main__":
    compare_hierarchies()
    print("same", flush=True)
