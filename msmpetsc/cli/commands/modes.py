"""``msmpetsc modes``: print natural frequencies of a scene's bodies; write their shapes."""

import argparse
import json

from mpi4py import MPI

from msmpetsc.app.mode_shapes import find_modes
from msmpetsc.app.request import RunRequest


def run(args: argparse.Namespace) -> int:
    """Find modes and print their frequencies; return the exit status (collective)."""
    comm = MPI.COMM_WORLD
    given = {"set": args.set, "overwrite": args.overwrite}
    modes = find_modes(comm, RunRequest(args.scene, args.output, **given), args.count)
    frequencies = modes.frequencies.tolist()
    if comm.rank:
        return 0
    if args.json:
        print(json.dumps({"frequencies": frequencies, "rigid": modes.rigid}))
        return 0
    print("mode  frequency [Hz]")
    for number, frequency in enumerate(frequencies, 1):
        words = "rigid" if number <= modes.rigid else f"{frequency:.6g}{' grows' * (frequency < 0)}"
        print(f"{number:4}  {words}")
    return 0
