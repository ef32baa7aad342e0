#!/usr/bin/env python3
"""A GPU beside the CPU of the same machine: bench.py with --gpu, under a name of its own for batch jobs."""

import sys

import bench

if __name__ == "__main__":
    sys.argv.insert(1, "--gpu")
    sys.exit(bench.main())
