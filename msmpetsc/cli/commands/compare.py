"""``msmpetsc compare``: print the differences of two results, and where they first differ."""

import argparse
import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.results.comparison import (
    Comparison,
    FieldError,
    compare,
    compare_surfaces,
    different_lattices,
    point_text,
    rest_of,
)
from msmpetsc.results.reader import Result

HEAD = (
    f"{'field':16} {'greatest error':>14} {'at frame':>8} {'first above':>11} {'relative to':>11}"
)


def run(args: argparse.Namespace) -> int:
    """Compare two results; return the exit status."""
    if not 0 <= args.rtol < np.inf:
        raise InputError(f"--rtol must be a number from 0 on, not {args.rtol:g}")
    with Result(args.first) as first, Result(args.second) as second:
        comparison, notes = compared(first, second)
        fields = {field.name: record(field, comparison, args.rtol) for field in comparison.fields}
        frames = len(comparison.pairs)
        times_differ = frames < max(len(first.frames.time), len(second.frames.time))
        agree = not times_differ and all(field["first_above"] is None for field in fields.values())
        if args.json:
            record_of_all = {
                "agree": agree,
                "rtol": args.rtol,
                "frames": frames,
                "fields": {name: field | for_json(field) for name, field in fields.items()},
                "left_out": list(comparison.left_out),
                "notes": notes,
            }
            print(json.dumps(record_of_all, indent=1))
        else:
            print("\n".join([*notes, *not_shared(first, second, comparison), HEAD]))
            print("\n".join(row(name, field) for name, field in fields.items()))
            print("\n".join(first_difference(first, comparison, args.rtol)))
            if times_differ:
                print("the results have different times, which counts as a difference")
    return int(not agree)


def compared(first: Result, second: Result) -> tuple[Comparison, list[str]]:
    """Return the comparison of two results, and notes; surfaces only if the lattices differ."""
    differ = different_lattices(first, second)
    if not differ:
        return compare(first, second), []
    try:
        comparison = compare_surfaces(first, second)
    except InputError as error:
        raise InputError(f"{differ}; {error}") from None
    _, mean = comparison.fields
    overall = np.sqrt(np.mean(mean.errors**2))
    return comparison, [
        f"{differ}: their surfaces alone are compared",
        f"surface error {overall:.3g}: rms over the surface and time, relative to the largest "
        f"displacement in {second.path}",
    ]


def record(field: FieldError, comparison: Comparison, rtol: float) -> dict[str, Any]:
    """Return the greatest difference of a field, with frame numbers of the first file."""
    greatest = int(np.argmax(field.errors))
    first = field.first_above(rtol)
    return {
        "error": float(field.errors[greatest]),
        "frame": int(comparison.pairs[greatest, 0]),
        "first_above": None if first is None else int(comparison.pairs[first, 0]),
        "scale": float(field.scale),
        "unit": field.unit,
    }


def for_json(field: dict[str, Any]) -> dict[str, None]:
    """Return null for the values of a field that are not finite, for which JSON has no number."""
    return {key: None for key in ("error", "scale") if not np.isfinite(field[key])}


def row(name: str, field: dict[str, Any]) -> str:
    """Return the line of a field in the table."""
    since = "-" if field["first_above"] is None else field["first_above"]
    scale = f"{field['scale']:.3g} {field['unit']}"
    return f"{name:16} {field['error']:14.3g} {field['frame']:8} {since:>11} {scale:>11}"


def not_shared(first: Result, second: Result, comparison: Comparison) -> Iterator[str]:
    """Yield notes on frames and fields that only one run has."""
    counts = [len(result.frames.time) for result in (first, second)]
    shared = len(comparison.pairs)
    if counts != [shared, shared]:
        span = f"from {comparison.times[0]:g} s to {comparison.times[-1]:g} s"
        yield (
            f"{counts[0]} and {counts[1]} frames, of which {shared} have the same time, {span}: "
            "these are compared"
        )
    for name in comparison.left_out:
        path = first.path if name in first.frames else second.path
        yield f"{name} is in {path} only: not compared"


def first_difference(result: Result, comparison: Comparison, rtol: float) -> Iterator[str]:
    """Yield lines on the first frame that differs and on the node that differs most there."""
    firsts = {
        field.name: first
        for field in comparison.fields
        if (first := field.first_above(rtol)) is not None
    }
    if not firsts:
        yield f"they agree to {rtol:g} at these {len(comparison.pairs)} frames"
        return
    first = min(firsts.values())
    names = ", ".join(name for name, index in firsts.items() if index == first)
    frame = comparison.pairs[first, 0]
    yield f"they differ from frame {frame} on, t = {comparison.times[first]:g} s: {names}"
    for field in comparison.fields:
        if field.name in ("position", "surface") and field.name in firsts:
            yield farthest(result, comparison, field, firsts[field.name])
            break


def farthest(result: Result, comparison: Comparison, field: FieldError, first: int) -> str:
    """Return a line on the node or surface point that differs most at a frame."""
    number = field.worst[first]
    rest_rows = rest_of(result, field.name)
    rest = f", at rest at {point_text(rest_rows[number])}" if rest_rows is not None else ""
    kind = "node" if field.name == "position" else "surface point"
    difference = field.errors[first] * (field.scale or 1.0)
    frame = comparison.pairs[first, 0]
    return f"{kind} {number}{rest}, is {difference:.3g} m off at frame {frame}, more than the rest"
