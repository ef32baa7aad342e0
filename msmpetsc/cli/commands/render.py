"""``msmpetsc render``: some moments of a result in one picture."""

import argparse

import numpy as np

from msmpetsc.cli.arguments import PICTURE_NAMES, refuse_below_one, refuse_other_format, refuse_ranks
from msmpetsc.errors import InputError
from msmpetsc.output.drawing.sheet import contact_sheet
from msmpetsc.output.reader import refuse_deadly


def run(args: argparse.Namespace) -> int:
    """Draw the picture and print its path; return the exit status."""
    refuse_ranks("render", "it draws on one process")
    refuse_below_one(count=args.count)
    refuse_other_format("-o", args.output, PICTURE_NAMES)
    picture = args.output or args.result.with_suffix(".png")
    frames = numbers("--frames", args.frames, int, "0,10,20")
    eye = numbers("--eye", args.eye, float, "1,-2,0.6")
    if eye is not None and not (len(eye) == 3 and any(eye) and np.isfinite(eye).all()):
        raise InputError(f"--eye takes three numbers, not all zero, not {args.eye!r}")
    refuse_deadly(args.result)
    print(contact_sheet(args.result, picture, frames, args.count, eye))
    return 0


def numbers(option: str, text: str | None, kind: type, example: str) -> list | None:
    """Return the numbers of "0,10,20". Raises InputError."""
    if text is None:
        return None
    try:
        return [kind(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{option} takes numbers like {example}, not {text!r}") from None
