"""Which frames of a result are drawn where none are asked for: those at given times, or those that tell the story."""

from collections.abc import Sequence

import numpy as np

from msmpetsc.output.reader import Result

COUNT = 5  # moments, where nothing is said


def moments_at(run: Result, times: Sequence[float]) -> dict[int, str]:
    """Return the start, and the finished frames nearest to these times [s], in order of time."""
    time = run.frames.time[:]
    nearest = {0, *(int(np.argmin(abs(time - wanted))) for wanted in times)}
    return {index: "" if index else "start" for index in sorted(nearest)}


def choose_moments(run: Result, count: int) -> dict[int, str]:
    """Return at most `count` frames that tell the story, in order of time, each with its reason.

    In order of importance: the first and the last; the greatest elastic energy; before it the greatest kinetic
    energy (a falling body is fastest just before it touches the ground); after it the greatest potential energy
    (the top of the leap). Where these coincide, the middle of the longest gap between chosen frames is added.
    """
    kinetic, elastic, potential = (run.frames[name][:] for name in ("kinetic", "elastic", "potential"))
    total = len(elastic)
    most_elastic = int(np.argmax(elastic))
    fastest = int(np.argmax(kinetic[: most_elastic + 1]))
    highest = most_elastic + int(np.argmax(potential[most_elastic:]))
    moments = {0: "start", total - 1: "end"}
    for index, reason in (most_elastic, "most elastic energy"), (fastest, "fastest"), (highest, "highest"):
        if len(moments) < count:
            moments.setdefault(index, reason)
    while len(moments) < min(count, total):
        chosen = sorted(moments)
        widest = int(np.argmax(np.diff(chosen)))
        moments[(chosen[widest] + chosen[widest + 1]) // 2] = ""
    return dict(sorted(moments.items())[:count])
