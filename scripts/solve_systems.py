#!/usr/bin/env python3
"""Solve linear systems of `--export` by any of PETSc's solvers, and compare with our multigrid.

scripts/solve_systems.py out/systems/*/step_1 --options "-pc_type gamg" "-pc_type hypre"
"""

import json
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path
from time import perf_counter

import clone  # noqa: F401 (starts the script again by .venv)

from petsc4py import PETSc

from msmpetsc.study.report import write_report
from msmpetsc.study.table import write_table

OURS, COLUMNS = "our multigrid", ("ksp_its", "time_setup", "time_frame", "status", "distance")
USUAL = "-ksp_type cg -ksp_rtol 1e-8 -ksp_norm_type unpreconditioned -ksp_max_it 5000 "


def read(path, *objects):
    viewer = PETSc.Viewer().createBinary(str(path), "r", PETSc.COMM_WORLD)
    return [each.create(PETSc.COMM_WORLD).load(viewer) for each in objects]


def solve(folder, options):
    """Return iterations, times, whether it converged, and the error of the correction [-]."""
    PETSc.Options().insertString(USUAL + options)
    (matrix,) = read(folder / "hessian.bin", PETSc.Mat())
    f, exact = (read(folder / f"{n}.bin", PETSc.Vec())[0] for n in ("residual", "correction"))
    modes = read(folder / "rigid_modes.bin", *(PETSc.Vec() for _ in range(6)))
    matrix.setNearNullSpace(PETSc.NullSpace().create(vectors=modes))
    ksp, y, times = PETSc.KSP().create(), exact.duplicate(), [perf_counter()]
    ksp.setOperators(matrix)
    ksp.setFromOptions()
    for work in (ksp.setUp, lambda: ksp.solve(f, y)):
        times.append(work() or perf_counter())
    for name in PETSc.Options().getAll():
        PETSc.Options().delValue(name)
    ends = "ok" if ksp.reason > 0 else "failed"
    error = (y - exact).norm() / exact.norm()
    return ksp.its, times[1] - times[0], times[2] - times[1], ends, error


def main():
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="DIR/step_N")
    parser.add_argument("--options", nargs="+", default=[], help="a string for each solver")
    parser.add_argument("-o", "--output", type=Path, help="folder of a study's table and report")
    args, rows, is_root = parser.parse_args(), [], PETSc.COMM_WORLD.rank == 0
    for folder in args.folders:
        if not (folder / "system.json").is_file():
            parser.error(f"{folder} is no folder step_N of --export")
        ours = json.loads((folder / "system.json").read_text())["multigrid"]
        for label in (OURS, *args.options):
            figures = (*ours.values(), 0.0) if label == OURS else solve(folder, label)
            rows.append(dict(zip(COLUMNS, figures, strict=True), scene=f"{folder}", label=label))
            print(*rows[-1].values(), sep="  ") if is_root else None
    if args.output and is_root:
        args.output.mkdir(parents=True, exist_ok=True)
        write_table(args.output, rows)
        print(write_report(args.output))


if __name__ == "__main__":
    main()
