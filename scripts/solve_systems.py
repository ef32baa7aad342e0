#!/usr/bin/env python3
"""Solve linear systems of `--export` by any of PETSc's solvers, beside our multigrid.

    scripts/solve_systems.py out/systems/*/step_1 --options "-pc_type gamg" "-pc_type hypre"

A solve is CG from 0 to |F - H y| = 1e-8 |F|, unless its options say otherwise. BDDC needs mpiexec
with the ranks of the export. `-o FOLDER` writes the table and the report of a study.
"""

import json
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path
from time import perf_counter

import clone  # noqa: F401 (starts the script again by .venv)

from petsc4py import PETSc

from msmpetsc.study.report import write_report
from msmpetsc.study.table import write_table

USUAL = "-ksp_type cg -ksp_rtol 1e-8 -ksp_norm_type unpreconditioned -ksp_max_it 5000 "


def read(path, *objects, comm=PETSc.COMM_WORLD):
    viewer = PETSc.Viewer().createBinary(str(path), "r", comm)
    return [each.create(comm).load(viewer) for each in objects]


def solve(folder, options):
    """Return iterations, times, whether CG converged, and the error of the correction [-]."""
    PETSc.Options().insertString(USUAL + options)
    (matrix,) = read(folder / "hessian.bin", PETSc.Mat())
    if "bddc" in options:
        own = folder / f"subdomain_{PETSc.COMM_WORLD.rank}.bin"
        part, rows = read(own, PETSc.Mat(), PETSc.IS(), comm=PETSc.COMM_SELF)
        numbers = PETSc.LGMap().create(rows.indices)
        matrix = PETSc.Mat().createIS(matrix.getSizes(), numbers, numbers)
        matrix.setISLocalMat(part)
        matrix.assemble()
    f, exact = (read(folder / f"{n}.bin", PETSc.Vec())[0] for n in ("residual", "correction"))
    modes = read(folder / "rigid_modes.bin", *(PETSc.Vec() for _ in range(6)))
    matrix.setNearNullSpace(PETSc.NullSpace().create(vectors=modes))
    ksp, y, begun = PETSc.KSP().create(), exact.duplicate(), perf_counter()
    ksp.setOperators(matrix)
    ksp.setFromOptions()
    ksp.setUp()
    ready = perf_counter()
    ksp.solve(f, y)
    times = ready - begun, perf_counter() - ready
    PETSc.Options().clear()
    return ksp.its, *times, ksp.reason > 0, (y - exact).norm() / exact.norm()


def main():
    parser, table = (
        ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter),
        [],
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="DIR/step_N")
    parser.add_argument("--options", nargs="+", default=[], help="a string for each solver")
    parser.add_argument("-o", "--output", type=Path)
    args, names = (
        parser.parse_args(),
        ("ksp_its", "time_setup", "time_frame", "status", "distance"),
    )
    for folder in args.folders:
        ours = json.loads((folder / "system.json").read_text())["multigrid"]
        found = {"our multigrid": [*ours.values(), 0.0]} | {
            o: solve(folder, o) for o in args.options
        }
        for label, values in found.items():
            table.append(
                {"scene": f"{folder}", "label": label} | dict(zip(names, values, strict=True))
            )
            table[-1]["status"] = "ok" if table[-1]["status"] else "failed"
            print(*table[-1].values(), sep="  ") if PETSc.COMM_WORLD.rank == 0 else None
    if args.output and PETSc.COMM_WORLD.rank == 0:
        args.output.mkdir(parents=True, exist_ok=True)
        write_table(args.output, table)
        print(write_report(args.output))


if __name__ == "__main__":
    main()
