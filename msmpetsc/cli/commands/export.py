"""``msmpetsc export``: frames of a result in the format of another program."""

import argparse

from msmpetsc.export.formats import export
from msmpetsc.results.reader import refuse_deadly


def run(args: argparse.Namespace) -> int:
    """Export the result and print the path of what was written; return the exit status."""
    refuse_deadly(args.result)
    print(export(args.result, args.output, args.frames))
    return 0
