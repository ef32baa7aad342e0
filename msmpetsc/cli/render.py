"""msmpetsc render: some moments of a result in one picture."""

import argparse
from pathlib import Path

from msmpetsc.errors import InputError


def add_parser(subparsers) -> None:
    """Add the command to argparse's `subparsers`."""
    parser = subparsers.add_parser("render", help="draw some moments of a result side by side")
    parser.add_argument("result", metavar="OUT.h5", type=Path)
    parser.add_argument("-o", "--output", metavar="PNG", type=Path, help="default: beside the result, ending in .png")
    parser.add_argument("--frames", metavar="0,10,20", help="these frames, in this order")
    parser.add_argument("--count", metavar="N", type=int, default=5, help="how many moments to choose (default: 5)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Draw and name the picture; returns the exit status."""
    from msmpetsc.output.render import contact_sheet  # here: the other commands need no graphics

    if args.count < 1:
        raise InputError(f"--count must be at least 1, not {args.count}")
    picture = args.output or args.result.with_suffix(".png")
    print(contact_sheet(args.result, picture, _frames(args.frames), args.count))
    return 0


def _frames(text: str | None) -> list[int] | None:
    """ "0,10,20" as numbers."""
    if text is None:
        return None
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"--frames takes numbers like 0,10,20, not {text!r}") from None
