"""``msmpetsc fetch``: download named meshes, or list them."""

import argparse
import sys

from msmpetsc.errors import InputError
from msmpetsc.geometry.registry import MODELS, fetch, find


def run(args: argparse.Namespace) -> int:
    """Download each named model and print its path and licence, or print the table of models."""
    if args.list:
        print("\n".join(_table()))
    elif not args.names:
        raise InputError("fetch which mesh? (msmpetsc fetch --list shows them)")
    for name in args.names:
        path = fetch(name, progress=sys.stderr.isatty())
        print(f"{name}: {path}\n  {MODELS[name].credit} ({MODELS[name].licence})")
    return 0


def _table() -> list[str]:
    """Return the lines of the table of models: name, size, place and licence."""
    lines = [f"{'name':12} {'MB':>6}  {'found':26} licence"]
    for name, model in MODELS.items():
        size = "-"
        where = "not here"
        try:
            if file := find(name):
                size = f"{file.path.stat().st_size / 1e6:.1f}"
                where = file.where
        except InputError:
            where = "another file of its name"
        lines.append(f"{name:12} {size:>6}  {where:26} {model.licence}")
    return lines
