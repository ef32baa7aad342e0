"""``msmpetsc compare``: do two results agree, and if not, from which frame and node on."""

import argparse

import numpy as np

from msmpetsc.cli.arguments import file_argument, refuse_ranks
from msmpetsc.errors import InputError
from msmpetsc.output.compare import Comparison, FieldError, compare, point_text, rest_of
from msmpetsc.output.reader import Result, refuse_deadly

SAME, DIFFERENT = 0, 1
HEAD = f"{'field':16} {'greatest error':>14} {'at frame':>8} {'first above':>11} {'relative to':>11}"


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "compare",
        help="say whether two results agree",
        description="Compare two results of one lattice at the times that both have. Exit status 0: they agree; "
        "1: they differ; 2: they cannot be compared.",
    )
    parser.add_argument("one", metavar="A.h5", type=file_argument)
    parser.add_argument("other", metavar="B.h5", type=file_argument)
    parser.add_argument("--rtol", type=float, default=1e-6, metavar="E", help="relative error that still agrees (1e-6)")
    parser.add_argument(
        "--fields", metavar="NAME,...", help="of /frames; position, surface, the energies and momentum if not given"
    )
    parser.add_argument(
        "--shared", action="store_true", help="times that only one of them has do not count as different"
    )


def run(args: argparse.Namespace) -> int:
    """Compare; returns the exit status."""
    refuse_ranks("compare", "it reads two files, which one process does alone")
    if not 0 <= args.rtol < np.inf:
        raise InputError(f"--rtol must be a number from 0 on, not {args.rtol:g}")
    names = None if args.fields is None else [name.strip() for name in args.fields.split(",")]
    refuse_deadly(args.one)
    refuse_deadly(args.other)
    with Result(args.one) as one, Result(args.other) as other:
        found = compare(one, other, names)
        tell_what_is_not_shared(one, other, found)
        for line in (HEAD, *(row(field, found, args.rtol) for field in found.fields)):
            print(line)
        differs = tell_first_difference(one, found, args.rtol)
        apart = len(found.pairs) < max(len(one.frames.time), len(other.frames.time)) and not args.shared
        if apart:
            print("they have not the same times, which counts as different without --shared")
    return DIFFERENT if differs or apart else SAME


def tell_what_is_not_shared(one: Result, other: Result, found: Comparison) -> None:
    """Frames and fields that one run alone has."""
    counts, shared = [len(result.frames.time) for result in (one, other)], len(found.pairs)
    if counts != [shared, shared]:
        span = f"from {found.times[0]:g} s to {found.times[-1]:g} s"
        print(f"{counts[0]} and {counts[1]} frames, of which {shared} have the same time, {span}: these are compared")
    for name in found.left_out:
        print(f"{name} is in {one.path if name in one.frames else other.path} only: not compared")


def row(field: FieldError, found: Comparison, rtol: float) -> str:
    """A line of the table; frames are numbered as in the first file."""
    at, first = int(np.argmax(field.errors)), field.first_above(rtol)
    since = "-" if first is None else found.pairs[first, 0]
    scale = f"{field.scale:.3g} {field.unit if field.unit != '1' else ''}".rstrip()
    return f"{field.name:16} {field.errors[at]:14.3g} {found.pairs[at, 0]:8} {since:>11} {scale:>11}"


def tell_first_difference(one: Result, found: Comparison, rtol: float) -> bool:
    """The first frame at which anything differs, and the node that is farthest off when positions first do."""
    firsts = {field.name: first for field in found.fields if (first := field.first_above(rtol)) is not None}
    if not firsts:
        print(f"they agree to {rtol:g} at these {len(found.pairs)} frames")
        return False
    first = min(firsts.values())
    names = ", ".join(name for name, at in firsts.items() if at == first)
    print(f"they differ from frame {found.pairs[first, 0]} on, t = {found.times[first]:g} s: {names}")
    for field in found.fields:
        if field.name in ("position", "surface") and field.name in firsts:
            tell_node(one, found, field, firsts[field.name])
            break
    return True


def tell_node(one: Result, found: Comparison, field: FieldError, first: int) -> None:
    number, rest_rows = field.worst[first], rest_of(one, field.name)
    rest = f", at rest at {point_text(rest_rows[number])}" if rest_rows is not None else ""
    kind = "node" if field.name == "position" else "surface point"
    off = f"{field.errors[first] * field.scale:.3g} m off at frame {found.pairs[first, 0]}"
    print(f"{kind} {number}{rest}, is {off}, farther than any other")
