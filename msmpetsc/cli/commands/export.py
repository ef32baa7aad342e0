"""``msmpetsc export``: write frames of a result in another format."""

import argparse

from msmpetsc.export.formats import export
from msmpetsc.results.untrusted_file import refuse_deadly


def run(args: argparse.Namespace) -> int:
    """Export the result and print the path of the file; return the exit status."""
    refuse_deadly(args.result)
    print(export(args.result, args.output, args.frames))
    return 0
