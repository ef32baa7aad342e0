#!/usr/bin/env python3
"""A GPU beside the CPU of the same machine: bench.py with --gpu, under a name of its own for batch jobs."""

import sys

from bench import main

sys.argv.insert(1, "--gpu")

if __name__ == "__main__":
    sys.exit(main())
