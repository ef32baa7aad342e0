"""msmpetsc render: some moments of a result in one picture."""

import argparse

import numpy as np

from msmpetsc.cli.arguments import PICTURE_NAMES, file_argument, refuse_below_one, refuse_other_format, refuse_ranks
from msmpetsc.errors import InputError


def add_parser(subparsers) -> None:
    """Add the command to argparse's `subparsers`."""
    parser = subparsers.add_parser("render", help="draw some moments of a result side by side")
    parser.add_argument("result", metavar="OUT.h5", type=file_argument)
    parser.add_argument(
        "-o", "--output", metavar="PNG", type=file_argument, help="default: beside the result, ending in .png"
    )
    parser.add_argument("--frames", metavar="0,10,20", help="these frames, in this order")
    parser.add_argument(
        "--count", metavar="N", type=int, help="choose this many moments (default: the scene's picture.times, or 5)"
    )
    parser.add_argument("--eye", metavar="X,Y,Z", help="direction from the body to the eye (--eye=-1,2,0.5)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Draw and name the picture; returns the exit status."""
    from msmpetsc.output.reader import refuse_deadly
    from msmpetsc.output.render import contact_sheet  # here: the other commands need no graphics

    refuse_ranks("render", "it draws on one process")
    refuse_below_one(args, "count")
    refuse_other_format("-o", args.output, PICTURE_NAMES)
    picture = args.output or args.result.with_suffix(".png")
    frames = _numbers("--frames", args.frames, int, "0,10,20")
    eye = _numbers("--eye", args.eye, float, "1,-2,0.6")
    if eye is not None and not (len(eye) == 3 and any(eye) and np.isfinite(eye).all()):
        raise InputError(f"--eye takes three numbers, not all zero, not {args.eye!r}")
    refuse_deadly(args.result)
    print(contact_sheet(args.result, picture, frames, args.count, eye))
    return 0


def _numbers(option: str, text: str | None, kind: type, example: str) -> list | None:
    """ "0,10,20" as numbers."""
    if text is None:
        return None
    try:
        return [kind(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{option} takes numbers like {example}, not {text!r}") from None
