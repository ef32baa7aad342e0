"""``msmpetsc series``: energies, forces and places of probes of a result, a row a frame."""

import argparse
import sys

from msmpetsc.errors import InputError
from msmpetsc.results.disk import write_whole
from msmpetsc.results.reader import Result, plain_damage, refuse_deadly
from msmpetsc.results.time_series import series_text
from msmpetsc.view.drawable import read_scene


def run(args: argparse.Namespace) -> int:
    """Write the series, or print it; return the exit status."""
    if args.output and args.output.exists() and not args.overwrite:
        raise InputError(f"{args.output} exists already: --overwrite replaces it")
    refuse_deadly(args.result)
    with plain_damage(args.result), Result(args.result) as result:
        text = series_text(result, read_scene(result))
    if args.output is None:
        sys.stdout.write(text)
        return 0
    write_whole(args.output, text)
    print(args.output)
    return 0
