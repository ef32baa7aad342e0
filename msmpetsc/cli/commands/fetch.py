"""``msmpetsc fetch``: download named meshes, or list them."""

import argparse
import sys

from msmpetsc.errors import InputError
from msmpetsc.geometry.registry import MODELS, fetch, find


def run(args: argparse.Namespace) -> int:
    """Fetch each named model and print its path and licence, or print the table."""
    if args.list:
        print("\n".join(_table()))
    elif not args.names:
        raise InputError("fetch which mesh? (msmpetsc fetch --list shows them)")
    for name in args.names:
        path = fetch(name, progress=sys.stderr.isatty())
        print(f"{name}: {path}\n  {MODELS[name].credit} ({MODELS[name].licence})")
    return 0


def _table() -> list[str]:
    """Return one line a model: name, size [MB] of its file, where that lies, licence."""
    rows = [("name", "MB", "found", "licence")]
    for name, model in MODELS.items():
        try:
            file = find(name)
        except InputError:
            file, where = None, "another file of its name"
        else:
            where = file.where if file else "not here"
        size = f"{file.path.stat().st_size / 1e6:.1f}" if file else "-"
        rows.append((name, size, where, model.licence))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        f"{name:{widths[0]}}  {size:>{widths[1]}}  {where:{widths[2]}}  {licence}"
        for name, size, where, licence in rows
    ]
