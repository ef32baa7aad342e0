"""`msmpetsc fetch`: download named meshes, or list them."""

import argparse
import sys

from msmpetsc.cli.arguments import refuse_ranks
from msmpetsc.errors import InputError
from msmpetsc.geometry.registry import MODELS, fetch, find


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = subparsers.add_parser("fetch", help="download named meshes, or list them")
    parser.add_argument("names", nargs="*", metavar="NAME", help="a model, see --list")
    parser.add_argument("--list", action="store_true", help="list the models and where they lie")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Fetch each named model and print its path and licence, or print the table."""
    refuse_ranks("fetch", "it downloads on one process")
    if args.list:
        print("\n".join(_table()))
    elif not args.names:
        raise InputError("fetch which mesh? (msmpetsc fetch --list shows them)")
    for name in args.names:
        path = fetch(name, progress=sys.stderr.isatty())
        print(f"{name}: {path}\n  {MODELS[name].credit} ({MODELS[name].licence})")
    return 0


def _table() -> list[str]:
    """One line a model: name, size [MB] of the file found, where it was found, licence."""
    rows = [("name", "MB", "found", "licence")]
    for name, model in MODELS.items():
        try:
            found = find(name)
        except InputError:
            found, where = None, "another file of its name"
        else:
            where = found.where if found else "not here"
        size = f"{found.path.stat().st_size / 1e6:.1f}" if found else "-"
        rows.append((name, size, where, model.licence))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        f"{name:{widths[0]}}  {size:>{widths[1]}}  {where:{widths[2]}}  {licence}"
        for name, size, where, licence in rows
    ]
