"""``msmpetsc keys``: the keys of a scene, each with its unit, default, range and meaning."""

import argparse
from dataclasses import astuple

from msmpetsc.scene.key_table import keys

HEAD = ("key", "unit", "default", "range", "meaning")


def run(args: argparse.Namespace) -> int:
    """Print a line a key; return the exit status."""
    rows = [HEAD, *(astuple(key) for key in keys(args.table or ""))]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)][:-1]
    for *columns, meaning in rows:
        print("  ".join([*(f"{text:{width}}" for text, width in zip(columns, widths, strict=True)), meaning]).rstrip())
    return 0
