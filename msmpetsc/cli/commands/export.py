"""``msmpetsc export``: write frames of a result in another format."""

import argparse

from msmpetsc.export.formats import export


def run(args: argparse.Namespace) -> int:
    """Export the result and print the path of the file; return the exit status."""
    print(export(args.result, args.output, args.frames))
    return 0
