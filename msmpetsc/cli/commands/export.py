"""``msmpetsc export``: frames of a result in the format of another program."""

import argparse

from msmpetsc.cli.arguments import refuse_below_one, refuse_ranks
from msmpetsc.cli.commands.render import numbers
from msmpetsc.output.export.formats import export
from msmpetsc.output.reader import refuse_deadly


def run(args: argparse.Namespace) -> int:
    """Export the result and print the path of what was written; return the exit status."""
    refuse_ranks("export", "it writes on one process")
    refuse_below_one(every=args.every)
    frames = numbers("--frames", args.frames, int, "0,10,20")
    refuse_deadly(args.result)
    print(export(args.result, args.output, args.mesh, frames, args.every))
    return 0
