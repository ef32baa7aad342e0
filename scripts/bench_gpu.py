#!/usr/bin/env python3
"""A GPU beside the CPU of the same machine.

    scripts/bench_gpu.py [--only NAME ...] [--frames N] [--repeats N] [--ranks N] [--large] [-o PAGE]

The rows of bench.py, the paper's scenes and beams of 9,000 to 995,000 cells, by `newton` on one core, with --ranks on
so many, and on the GPU. What a step consists of, on either, `msmpetsc run -log_view` tells; what it launches and
carries between CPU and GPU, `nsys profile`.
"""

import sys

import lab

import bench
from petsc4py import PETSc

from msmpetsc.backend import cuda
from msmpetsc.solve.petsc import device


def main() -> int:
    args = bench.parser(__doc__, 1).parse_args()
    if lacking := device.what_is_missing():
        print(f"bench_gpu: {lacking}", file=sys.stderr)
        return 2
    words = bench.METHODS[bench.TODAY].words
    methods = {"one core": bench.Method(words)}
    if args.ranks > 1:
        methods[f"{args.ranks} cores"] = bench.Method(words, args.ranks)
    methods["GPU"] = bench.Method((*words, "--device", "cuda"))
    with lab.page(args):
        print(f"{cuda.name()}, PETSc {'.'.join(map(str, PETSc.Sys.getVersion()))}")
        lab.table(bench.rows(methods, args))
    return 0


if __name__ == "__main__":
    sys.exit(main())
